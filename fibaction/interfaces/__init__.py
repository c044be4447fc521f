"""ROS 2 interface files: parser, search path, and the Python types made from them.

Needs no ROS and no build step. `fibaction.action_files` is the public interface.
"""

from fibaction.interfaces.definitions import InterfaceError
from fibaction.interfaces.files import ActionFile, read_action
from fibaction.interfaces.source import python_source
from fibaction.interfaces.structs import make_structs

__all__ = ["ActionFile", "InterfaceError", "make_structs", "python_source", "read_action"]
