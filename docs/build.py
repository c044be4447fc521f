"""Build the documentation into site/, or report its faults.

    python docs/build.py

First the parts that are generated from the code are written: the pictures of the statuses and of a
goal's life, and the marked parts of docs/concepts.md, docs/protocol.md, docs/howto/secure.md and
of the pages in docs/reference with the settings of transports.
Then the site is built strictly, and the built pages are checked: a link or an anchor without a
target, or a resource from another site, is a fault. The exit code is 1 if there are faults.
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
from javascript_parts import reference_part
from life_picture import life_diagram
from page_parts import with_parts
from protocol_parts import descriptions_part, limits_part, messages_part, schedules_part
from secure_parts import limits_part as all_limits_part
from secure_parts import memory_part
from settings_parts import SETTINGS_PARTS
from site_links import problems
from states_picture import diagram

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
SITE = ROOT / "site"

PICTURES: dict[str, Callable[[], str]] = {"states.svg": diagram, "life.svg": life_diagram}
"""Function that draws each picture from a table of the product."""

PARTS: dict[str, dict[str, Callable[[], str]]] = {
    "concepts.md": {"states": states_part, "errors": errors_part},
    "protocol.md": {
        "messages": messages_part,
        "descriptions": descriptions_part,
        "schedules": schedules_part,
        "limits": limits_part,
    },
    "howto/with_curl.md": {"reference of fibaction.js": reference_part},
    "howto/secure.md": {"limits": all_limits_part, "memory": memory_part},
    **SETTINGS_PARTS,
}
"""Function that makes the part between each pair of markers, by page."""


def generate() -> None:
    """Write the pictures that are drawn from tables, and the generated parts of the pages."""
    for name, picture in PICTURES.items():
        (DOCS / name).write_text(picture(), encoding="utf-8")
    for name, parts in PARTS.items():
        path = DOCS / name
        path.write_text(with_parts(path.read_text(encoding="utf-8"), parts), encoding="utf-8")
    # The lists that docs/shown_to_hold.md includes: made from the tests, and not committed.
    subprocess.run([sys.executable, "-m", "tests.tools.promises"], cwd=ROOT, check=True)


_COLORING = re.compile(r"\x1b\[[0-9;]*m")


def build() -> str:
    """Build the site, and return its faults; empty if there are none."""
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
        # The warnings name the faults; the traceback is about the tool itself.
        output = output.partition("Traceback (most recent call last)")[0]
    elif unknown := re.search(r"Could not collect '(.+)'", output):
        name = unknown[1]
        output = "".join(f"{place}: {name} does not exist\n" for place in _places_of(name))
    return output


def _places_of(name: str) -> Iterator[str]:
    for path in sorted(DOCS.rglob("*.md")):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if line == f"::: {name}":
                yield f"{path.relative_to(ROOT)}:{number}"


if __name__ == "__main__":
    argparse.ArgumentParser(
        prog="python docs/build.py",
        description="Build the documentation into site/, or report its faults.",
    ).parse_args()
    sys.exit(build() or None)
