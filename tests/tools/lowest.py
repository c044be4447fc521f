"""The lowest versions that `pyproject.toml` allows, as constraints for pip and uv.

    python -m tests.tools.lowest > lowest.txt

Only direct requirements of fibaction and its tests; theirs are the newest that fit.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


def constraints(project: Path = PROJECT) -> list[str]:
    """Return one line per library, sorted.

    Raises:
        ValueError: A requirement has no lower bound.
    """
    settings = tomllib.loads(project.read_text())
    requirements: list[str] = settings["project"]["dependencies"]
    for extra in settings["project"]["optional-dependencies"].values():
        requirements += extra
    requirements += settings["dependency-groups"]["test"]
    name = settings["project"]["name"]
    return sorted({lowest(each) for each in requirements if not re.match(rf"{name}\b", each)})


def lowest(requirement: str) -> str:
    """Return the constraint for one requirement."""
    library, _, _ = requirement.partition(";")  # whatever the marker: it is for all machines
    found = re.fullmatch(r"([\w.-]+)(?:\[[\w,-]+\])?>=([\w.]+)(?:,(?:<|!=)[\w.]+)?", library)
    if found is None:
        raise ValueError(f"no lower bound, or more than that: {requirement}")
    return f"{found[1]}=={found[2]}"


if __name__ == "__main__":
    argparse.ArgumentParser(
        prog="python -m tests.tools.lowest",
        description="Print the lowest versions that pyproject.toml allows, as constraints.",
    ).parse_args()
    sys.stdout.writelines(f"{line}\n" for line in constraints())
