"""The command `fibaction`: actions from a shell. Its parts need the extra `fibaction[cli]`.

Nothing else of fibaction knows of it.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec

NEEDED = ("click", "rich", "yaml", "jsonschema")
"""The modules that the extra brings."""
INTERRUPTED = 130
"""`ExitCode.INTERRUPTED`, whose module needs the extra."""


def main() -> None:
    """Run the command line, and exit with its code."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        sys.stderr.write(
            f"The command fibaction needs {', '.join(missing)}: pip install 'fibaction[cli]'\n"
        )
        sys.exit(2)
    try:
        from fibaction.cli import app

        app.main()
    except KeyboardInterrupt:  # while modules are imported; the verbs handle their own
        sys.exit(INTERRUPTED)
