"""The source of a page as it is served: without the comments, which are for its authors.

Only comments that are whole lines are left out, and the lines stay, empty, so that an error in a
browser has the line of the file. It is no parser: no line within a text of several lines may begin
as a comment does.
"""

from __future__ import annotations

import re

_COMMENT = re.compile(rb"^[ \t]*(?:/\*(?:[^*]|\*(?!/))*\*/[ \t]*|//[^\n]*)$", re.MULTILINE)
COMMENTED = (".css", ".js")
"""The suffixes of files that may have comments."""


def without_comments(source: bytes) -> bytes:
    """Return the source of a script or of a style sheet without its comments."""
    return _COMMENT.sub(lambda found: b"\n" * found[0].count(b"\n"), source)
