"""The command `fibaction`: actions from a shell.

Its parts need the extra `fibaction[cli]`. `python -m fibaction` imports it, and no other part of
fibaction.
"""

from __future__ import annotations

import sys

from fibaction.cli.process.exit_at_once import INTERRUPTED, exit_at_once

NEEDED = ("click", "rich", "yaml")
"""The modules that the extra brings."""


def main() -> None:
    """Run the command line, and exit with its code.

    Ctrl-C ends it quietly at any time: before a verb runs and after it has ended by `exit_at_once`,
    meanwhile as the verb says.
    """
    try:
        # All imports come after the handler, because they take longer than the rest.
        import signal

        signal.signal(signal.SIGINT, exit_at_once)
        try:
            _run()
        finally:
            if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
                signal.signal(signal.SIGINT, exit_at_once)
    except KeyboardInterrupt:  # in the moments in which a verb begins or ends
        sys.exit(INTERRUPTED)


def _run() -> None:
    from importlib.util import find_spec

    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        sys.stderr.write(
            f"The command fibaction needs {', '.join(missing)}: pip install 'fibaction[cli]'\n"
        )
        sys.exit(2)
    from fibaction.cli import app

    app.main()
