"""A release in a scratch copy of the files that it changes: all of them, once, or none."""

from __future__ import annotations

import re
import shutil
import subprocess
from datetime import date
from pathlib import Path

import pytest
import yaml

from tests.tools.release.__main__ import run
from tests.tools.release.changelog import date_of
from tests.tools.release.prepare import check_checkout, files, prepared
from tests.tools.release.sentences import SENTENCES

ROOT = Path(__file__).resolve().parents[3]
pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="a release is of a repository")

DAY = date(2026, 12, 1)
NEXT = "7.8.9"
"""A version that no file has yet."""
UNPUBLISHED = re.compile(
    r"not (yet )?published|fibaction is published|pip install (--\S+ )*[\"']?(\$HOME|~|\.|/fib)"
)


def git(root: Path, *arguments: str) -> None:
    who = ("-c", "user.name=someone", "-c", "user.email=someone@example.org")
    subprocess.run(["git", "-C", root, *who, *arguments], check=True, capture_output=True)


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    """A repository with the files that a release changes, as they are in this checkout."""
    for file in files():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    changelog = tmp_path / "CHANGELOG.md"
    text = changelog.read_text(encoding="utf-8")
    # On the day after a release nothing is new yet.
    changelog.write_text(
        text.replace("## [Unreleased]\n", "## [Unreleased]\n\n- News.\n"), encoding="utf-8"
    )
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "Begin")
    return tmp_path


def texts(root: Path) -> dict[str, str]:
    return {file: (root / file).read_text(encoding="utf-8") for file in files()}


def test_every_file_gets_the_version_and_its_day(scratch: Path) -> None:
    assert run(scratch, "prepare", NEXT, DAY) == []

    found = texts(scratch)
    for file in (
        "pyproject.toml",
        "fibaction/_runtime/__init__.py",
        "zensical.toml",
        "docs/cli.md",
    ):
        assert NEXT in found[file]
    assert "This is version 7.8, and" in found["README.md"]
    assert "| 7.8, and the newest commit |" in found["SECURITY.md"]
    assert yaml.safe_load(found["CITATION.cff"])["version"] == NEXT
    assert yaml.safe_load(found["CITATION.cff"])["date-released"] == DAY
    assert date_of(found["CHANGELOG.md"], NEXT) == "2026-12-01"


def test_no_page_says_that_it_is_not_published(scratch: Path) -> None:
    found = prepared(scratch, NEXT, DAY)

    for sentence in SENTENCES:
        assert sentence.after in found[sentence.page]
    pages = [path for path in (ROOT / "docs").rglob("*.md") if path.name != "changelog.md"]
    for path in [ROOT / "README.md", *pages]:
        name = path.relative_to(ROOT).as_posix()
        text = found.get(name) or path.read_text(encoding="utf-8")
        left = UNPUBLISHED.search(text)
        assert left is None, f"{name} needs a sentence in sentences.py: {left[0]}"


def test_a_second_run_changes_nothing_but_the_day(scratch: Path) -> None:
    run(scratch, "prepare", NEXT, DAY)
    first = texts(scratch)
    later = date(2026, 12, 2)

    assert run(scratch, "prepare", NEXT, later) == []

    assert texts(scratch) == {
        file: text.replace("2026-12-01", "2026-12-02")
        if file in ("CHANGELOG.md", "CITATION.cff")
        else text
        for file, text in first.items()
    }


def test_a_file_that_is_not_as_it_has_to_be_leaves_all_others_alone(scratch: Path) -> None:
    (scratch / "docs/tutorial.md").write_text("# Another tutorial\n", encoding="utf-8")
    before = texts(scratch)

    (wrong,) = run(scratch, "prepare", NEXT, DAY)

    assert "docs/tutorial.md has not this passage any more" in wrong
    assert texts(scratch) == before


def test_a_file_that_is_not_committed_would_be_published_so_there_must_be_none(
    scratch: Path,
) -> None:
    (scratch / "docs/draft.md").write_text("not for others", encoding="utf-8")
    before = texts(scratch)

    (wrong,) = run(scratch, "prepare", NEXT, DAY)

    assert wrong == "commit or remove first what is not committed: docs/draft.md"
    assert texts(scratch) == before


def test_a_version_that_is_tagged_is_never_built_again(scratch: Path) -> None:
    git(scratch, "tag", f"v{NEXT}")

    with pytest.raises(ValueError, match=f"v{NEXT} is tagged"):
        check_checkout(scratch, NEXT)
    check_checkout(scratch, "7.8.10")
