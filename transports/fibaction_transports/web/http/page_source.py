"""The source of a page as it is served: without comments and indents, which are for its authors.

Only comments that are whole lines are left out, and the lines stay, empty, so that an error in a
browser has the line of the file. Nothing is parsed, so a page has no texts of several lines.
"""

from __future__ import annotations

import re

_COMMENT = re.compile(rb"^[ \t]*(?:/\*(?:[^*]|\*(?!/))*\*/[ \t]*|//[^\n]*)$", re.MULTILINE)
_INDENT = re.compile(rb"^[ \t]+", re.MULTILINE)
COMMENTED = (".css", ".js")
"""The suffixes of files that may have comments."""


def as_served(source: bytes) -> bytes:
    """Return the source of a script or of a style sheet without its comments and indents."""
    return _INDENT.sub(b"", _COMMENT.sub(lambda found: b"\n" * found[0].count(b"\n"), source))
