"""`python -m fibaction`: the command `fibaction`, where its script is not on the path."""

from __future__ import annotations

from fibaction.cli import main

if __name__ == "__main__":
    main()
