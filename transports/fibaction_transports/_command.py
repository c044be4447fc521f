"""Entry point of the command `fibaction`.

It is in this package because importing `fibaction` takes a tenth of a second, in which Ctrl-C would
be a traceback. This package imports nothing, so the command can handle Ctrl-C first.
"""

from __future__ import annotations

import sys

INTERRUPTED = 130
"""The exit code after Ctrl-C, the same as in shells."""


def main() -> None:
    """Run the command line, and exit with its code."""
    try:
        # Imported after the `try`, since Ctrl-C may come at any moment.
        import os
        import signal

        signal.signal(signal.SIGINT, lambda _number, _frame: os._exit(INTERRUPTED))
        from fibaction.cli import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
