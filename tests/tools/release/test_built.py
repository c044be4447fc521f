"""The check of what is built finds each fault, and finds none where there is none."""

from __future__ import annotations

import io
import json
import tarfile
import zipfile
from datetime import date
from pathlib import Path

import pytest

from tests.tools.release.__main__ import run
from tests.tools.release.built import NPM_FILES

GOOD = "# fibaction\n\n[Page](https://example.org/a), [below](#b)\n\npip install 'fibaction[cli]'\n"
HEADER = '<header><a class="md-source" href="x"><li>0.1.0</li></a></header>'


def write_wheel(root: Path, *, version: str = "0.1.0", text: str = GOOD) -> None:
    file = root / "dist" / "fibaction-0.1.0-py3-none-any.whl"
    metadata = f"Metadata-Version: 2.4\nName: fibaction\nVersion: {version}\n\n{text}"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("fibaction-0.1.0.dist-info/METADATA", metadata)


def write_npm(root: Path, *, version: str = "0.1.0", lacks: str = "") -> None:
    with tarfile.open(root / "build/release/fibaction-0.1.0.tgz", "w:gz") as archive:
        for name in NPM_FILES - {lacks}:
            content = json.dumps({"version": version}).encode()
            member = tarfile.TarInfo(f"package/{name}")
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder in which all is well."""
    for folder in ("dist", "build/release", "site"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "dist" / "fibaction-0.1.0.tar.gz").touch()
    (tmp_path / "site" / "index.html").write_text(HEADER, encoding="utf-8")
    write_wheel(tmp_path)
    write_npm(tmp_path)
    return tmp_path


def found(root: Path) -> list[str]:
    return run(root, "check", "0.1.0", date(2026, 12, 1))


def test_nothing_is_wrong_with_a_good_release(root: Path) -> None:
    assert found(root) == []


def test_a_package_of_another_version_beside_it_is_found(root: Path) -> None:
    (root / "dist" / "fibaction-0.0.9.tar.gz").touch()

    assert ["0.0.9" in wrong for wrong in found(root)] == [True]


def test_a_wheel_that_names_another_version_is_found(root: Path) -> None:
    write_wheel(root, version="0.0.9")

    assert found(root) == ["the wheel says that it is 0.0.9"]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (f"{GOOD}![A](docs/a.svg)\n", "the description has the relative link docs/a.svg"),
        (f"{GOOD}It is not published yet.\n", "says that fibaction is not published"),
        ("# fibaction\n", "does not say how to install fibaction"),
    ],
)
def test_a_description_that_is_wrong_for_the_index_is_found(
    root: Path, text: str, wrong: str
) -> None:
    write_wheel(root, text=text)

    assert [one.endswith(wrong) for one in found(root)] == [True]


def test_a_missing_package_for_javascript_is_found(root: Path) -> None:
    (root / "build/release/fibaction-0.1.0.tgz").unlink()

    assert found(root) == ["fibaction-0.1.0.tgz is missing: npm packs it"]


def test_a_package_for_javascript_without_its_types_or_of_another_version_is_found(
    root: Path,
) -> None:
    write_npm(root, lacks="fibaction.d.ts", version="0.0.9")

    assert found(root) == [
        "fibaction-0.1.0.tgz lacks ['fibaction.d.ts']",
        "fibaction-0.1.0.tgz says that it is 0.0.9",
    ]


def test_a_site_without_the_version_and_the_link_in_its_header_is_found(root: Path) -> None:
    (root / "site" / "index.html").write_text(
        '<header></header>0.1.0 <a class="md-source">', encoding="utf-8"
    )

    assert found(root) == [
        "the header of the site has not the version 0.1.0",
        "the header of the site has no link to the repository",
    ]
