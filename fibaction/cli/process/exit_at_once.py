"""The handler of Ctrl-C where nothing has to be cleaned up.

It imports nothing that costs time, since `fibaction.cli.main` sets it before all other imports.
"""

from __future__ import annotations

import os

INTERRUPTED = 130
"""`ExitCode.INTERRUPTED`, whose module needs the extra."""


def exit_at_once(_number: int, _frame: object) -> None:
    """Handle SIGINT where nothing has to be cleaned up.

    A `KeyboardInterrupt` in the middle of an import or of the interpreter's exit would be a
    traceback.
    """
    os._exit(INTERRUPTED)
