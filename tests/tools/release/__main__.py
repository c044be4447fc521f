"""The two ends of `make release`: the files before the build, and the check after it.

python -m tests.tools.release prepare VERSION
python -m tests.tools.release check VERSION
"""

from __future__ import annotations

import argparse
import sys
from datetime import date
from pathlib import Path

from tests.tools.release.built import faults
from tests.tools.release.prepare import check_checkout, prepared, write

ROOT = Path(__file__).resolve().parents[3]
LEFT = """\
dist/, build/release/ and site/ have version {version}, and nothing is uploaded. What is left is in
docs/contributing.md, under "A release": look at the changes, commit them, run .ci/run, and tag.
"""


def run(root: Path, step: str, version: str, day: date) -> list[str]:
    """Take a step, and return what is wrong, a sentence for each."""
    if step == "check":
        return faults(root, version)
    try:
        texts = prepared(root, version, day)
        check_checkout(root, version)
    except ValueError as exc:
        return [str(exc)]
    write(root, texts)
    return []


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.release", description="Prepare or check a release."
    )
    parser.add_argument("step", choices=["prepare", "check"])
    parser.add_argument("version", help="for example 0.1.0")
    chosen = parser.parse_args()
    if wrong := run(ROOT, chosen.step, chosen.version, date.today()):
        sys.exit("\n".join(wrong))
    if chosen.step == "check":
        print(LEFT.format(version=chosen.version), end="")


if __name__ == "__main__":
    main()
