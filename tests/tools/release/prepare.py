"""The files of a release: version, changelog and sentences, written into a checkout."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterable, Mapping
from datetime import date
from pathlib import Path

from tests.tools.release import places, sentences
from tests.tools.release.changelog import with_section

CHANGELOG = "CHANGELOG.md"
CITATION = "CITATION.cff"


def files() -> set[str]:
    """Return the files that a release changes."""
    return places.files() | sentences.pages() | {CHANGELOG}


def prepared(root: Path, version: str, day: date) -> dict[str, str]:
    """Return the text of each file of a release.

    Raises:
        ValueError: A file is not as it has to be; the text says which, and what to do.
    """
    texts = {file: (root / file).read_text(encoding="utf-8") for file in sorted(files())}
    for file in places.files():
        texts[file] = places.with_version(file, texts[file], version)
    for page in sentences.pages():
        texts[page] = sentences.published(page, texts[page])
    texts[CHANGELOG] = with_section(texts[CHANGELOG], version, day)
    texts[CITATION] = _with_date(texts[CITATION], day)
    return texts


def _with_date(citation: str, day: date) -> str:
    without = re.sub(r"^date-released: .*\n", "", citation, flags=re.MULTILINE)
    line = rf"\g<0>date-released: {day.isoformat()}\n"
    return re.sub(r"^version: .*\n", line, without, count=1, flags=re.MULTILINE)


def write(root: Path, texts: Mapping[str, str]) -> None:
    """Write the files."""
    for file, text in texts.items():
        (root / file).write_text(text, encoding="utf-8")


def check_checkout(root: Path, version: str) -> None:
    """Check that a checkout has no changes but those of a release, and no tag of the version.

    Files that are not committed would be in the sdist, too.

    Raises:
        ValueError: It has others, or the version is published.
    """
    status = _git(root, "status", "--porcelain", "--untracked-files=all").splitlines()
    if other := others(line[3:] for line in status):
        raise ValueError(f"commit or remove first what is not committed: {', '.join(other)}")
    if _git(root, "tag", "--list", f"v{version}"):
        raise ValueError(f"v{version} is tagged: a version is never built again")


def others(changed: Iterable[str]) -> list[str]:
    """Return the changed files that a release does not change."""
    return sorted(set(changed) - files())


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
