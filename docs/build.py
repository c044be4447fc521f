"""Build the documentation into site/, or say what is wrong with it.

    python docs/build.py

First the parts that are made from the code are made again: docs/states.svg, the marked parts of
docs/concepts.md and docs/protocol.md, and the lists that docs/guarantee_tests.md includes. Then the
site is built strictly, and its pages are read once more: a broken link or anchor, or a file that is
fetched from another site, ends with exit code 1.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from concepts_parts import errors_part, states_part
from page_parts import with_parts
from protocol_parts import descriptions_part, limits_part, messages_part
from site_links import problems
from states_picture import diagram

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
SITE = ROOT / "site"

PARTS: dict[str, dict[str, Callable[[], str]]] = {
    "concepts.md": {"states": states_part, "errors": errors_part},
    "protocol.md": {
        "messages": messages_part,
        "descriptions": descriptions_part,
        "limits": limits_part,
    },
}
"""The functions that make the text between each pair of markers of a page."""


def generate() -> None:
    """Write docs/states.svg, the marked parts of the pages, and the lists of tests."""
    (DOCS / "states.svg").write_text(diagram(), encoding="utf-8")
    for name, parts in PARTS.items():
        path = DOCS / name
        path.write_text(with_parts(path.read_text(encoding="utf-8"), parts), encoding="utf-8")
    subprocess.run([sys.executable, "-m", "tests.promises"], cwd=ROOT, check=True)


_COLORING = re.compile(r"\x1b\[[0-9;]*m")


def build() -> str:
    """Build the site, and return its faults, or an empty text."""
    generate()
    shutil.rmtree(SITE, ignore_errors=True)
    built = subprocess.run(
        [sys.executable, "-m", "zensical", "build", "--clean", "--strict"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if built.returncode == 0:
        return "\n".join(problems(SITE))
    output = _COLORING.sub("", built.stdout + built.stderr)
    if "Aborted because --strict" in output:
        # The warnings say it all; the traceback is that of the tool.
        output = output.partition("Traceback (most recent call last)")[0]
    elif unknown := re.search(r"Could not collect '(.+)'", output):
        output = "".join(f"{place}: there is no {unknown[1]}\n" for place in _asking(unknown[1]))
    return output


def _asking(name: str) -> Iterator[str]:
    for path in sorted(DOCS.rglob("*.md")):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if line == f"::: {name}":
                yield f"{path.relative_to(ROOT)}:{number}"


if __name__ == "__main__":
    argparse.ArgumentParser(
        prog="python docs/build.py",
        description="Build the documentation into site/, or say what is wrong with it.",
    ).parse_args()
    sys.exit(build() or None)
