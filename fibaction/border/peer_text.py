"""Text of a peer, made safe to log, to quote and to keep.

A peer may send text that clears the screen, that looks like a line of the log, or that is as long
as a message can be. So take your logger from `clean_logger`, and quote with `excerpt`:

    logger = clean_logger("my_package.house")
    logger.warning("%s sent an unknown message: %s", peer, excerpt(text))

One call of a logger writes only some lines in ten seconds, and then a line with the number of the
others, so no peer floods the log. If one call is about different things, name them:
`logger.warning(..., extra={"kind": status})`.

A reason of a peer is data, so it is not escaped; `shortened` cuts it to `REASON` characters.
"""

from fibaction._runtime.log import MESSAGE, clean_logger
from fibaction._runtime.text import REASON, excerpt, shortened, with_escapes

__all__ = ["MESSAGE", "REASON", "clean_logger", "excerpt", "shortened", "with_escapes"]
