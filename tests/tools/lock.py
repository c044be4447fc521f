"""The versions with which the project was last checked, as constraints for pip and uv.

    python -m tests.tools.lock > tests/tools/lock.txt

`make lock` does that. The workflows install with these versions, so that a release of a library
does not break the check of a change that has nothing to do with it; each night the newest are
tried. Without the lock, `make test` takes the newest that fit.

The lines are those of this environment, for all that the dependency groups below need. Of what is
not in it, because another system or another Python needs more, the newest is installed.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from collections.abc import Callable, Iterable
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
LOCK = Path(__file__).with_name("lock.txt")
GROUPS = ("test", "browser", "check", "docs", "release")
"""The dependency groups of the check."""
HEADER = """\
# The versions with which the check was made last: `make lock` writes them. The workflows install
# with them, and each night the newest are tried.
"""


def needed(project: Path = PROJECT) -> list[Requirement]:
    """Return what the project, its extras and the groups of the check require."""
    settings = tomllib.loads(project.read_text(encoding="utf-8"))
    lines: list[str] = [*settings["build-system"]["requires"]]
    lines += settings["project"]["dependencies"]
    for extra in settings["project"]["optional-dependencies"].values():
        lines += extra
    for group in GROUPS:
        lines += settings["dependency-groups"][group]
    name = settings["project"]["name"]
    found = map(Requirement, lines)
    return [each for each in found if each.name != name and applies(each, ())]


def applies(requirement: Requirement, extras: Iterable[str]) -> bool:
    """Return whether a requirement holds here, with these extras of what requires it."""
    marker = requirement.marker
    return marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras))


def versions(
    required: Iterable[Requirement], about: Callable[[str], tuple[str, list[str]]]
) -> dict[str, str]:
    """Return the version of each library that is required, and of those that it requires.

    `about` returns the version of a library, and its requirements.
    """
    found = dict[str, str]()
    seen = set[tuple[str, str]]()
    waiting = [*required]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        extras = {"", *requirement.extras} - {extra for of, extra in seen if of == name}
        if not extras:
            continue
        seen |= {(name, extra) for extra in extras}
        found[name], lines = about(name)
        theirs = map(Requirement, lines)
        waiting += [each for each in theirs if applies(each, extras)]
    return found


def installed(name: str) -> tuple[str, list[str]]:
    """Return the version of a library of this environment, and its requirements.

    Raises:
        ValueError: It is not installed.
    """
    try:
        library = distribution(name)
    except PackageNotFoundError:
        raise ValueError(f"{name} is not installed: make lock installs it") from None
    return library.version, library.requires or []


def locked(lock: Path = LOCK) -> dict[str, str]:
    """Return the versions of a lock."""
    lines = lock.read_text(encoding="utf-8").splitlines()
    found = (re.fullmatch(r"([a-z0-9-]+)==(\S+)", line) for line in lines)
    return {one[1]: one[2] for one in found if one is not None}


if __name__ == "__main__":
    argparse.ArgumentParser(
        prog="python -m tests.tools.lock",
        description="Print the versions of this environment, as constraints.",
    ).parse_args()
    sys.stdout.write(HEADER)
    sys.stdout.writelines(
        f"{name}=={version}\n" for name, version in sorted(versions(needed(), installed).items())
    )
