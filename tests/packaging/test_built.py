"""The wheel and the sdist: all that belongs in them, and nothing else."""

from __future__ import annotations

import email.policy
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from configparser import ConfigParser
from email.message import EmailMessage
from email.parser import BytesParser
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAME = f"{PROJECT['name']}-{PROJECT['version']}"

PACKAGES = {"fibaction": ROOT, "fibaction_transports": ROOT / "transports"}
FOLDERS = ("docs", "examples", "fibaction", "tests", "transports")
FILES = {
    ".gitignore",  # says which files of a checkout are made, and so are no sources
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CITATION.cff",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "LICENSE",
    "Makefile",
    "PKG-INFO",
    "README.md",
    "SECURITY.md",
    "pyproject.toml",
    "zensical.toml",
}
"""Beside the folders, in the sdist."""


CACHES = {".hypothesis", ".mypy_cache", ".pytest_cache", ".ruff_cache", "__pycache__"}
"""What tools leave in a checkout, at any depth."""


def sources(folder: Path, top: Path) -> Iterator[str]:
    """The files of a folder of the checkout, but for what tools left there."""
    for file in folder.rglob("*"):
        if file.is_file() and CACHES.isdisjoint(file.parts):
            yield file.relative_to(top).as_posix()


def text(wheel: Path, name: str) -> str:
    with zipfile.ZipFile(wheel) as archive:
        return archive.read(f"{NAME}.dist-info/{name}").decode()


@pytest.fixture
def metadata(wheel: Path) -> EmailMessage:
    raw = text(wheel, "METADATA").encode()
    return BytesParser(policy=email.policy.default.clone(utf8=True)).parsebytes(raw)


def test_the_wheel_has_the_modules_their_types_and_the_licence_and_nothing_else(
    wheel: Path,
) -> None:
    expected = {file for name, top in PACKAGES.items() for file in sources(top / name, top)}
    web = {file for file in expected if file.startswith("fibaction_transports/web/")}
    assert {Path(file).suffix for file in expected - web} == {".py", ".typed"}
    page = {".css", ".html", ".js", ".svg"}
    client = {".js", ".json", ".md", ".ts"}
    assert {Path(file).suffix for file in web} == {".py", *page, *client}
    expected |= {
        f"{NAME}.dist-info/{file}"
        for file in ("METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE")
    }
    with zipfile.ZipFile(wheel) as archive:
        assert set(archive.namelist()) == expected


@pytest.mark.parametrize("package", PACKAGES)
def test_the_types_of_both_packages_are_for_users_too(wheel: Path, package: str) -> None:
    with zipfile.ZipFile(wheel) as archive:
        assert f"{package}/py.typed" in archive.namelist()


def test_the_licence_is_the_projects(wheel: Path) -> None:
    assert text(wheel, "licenses/LICENSE") == (ROOT / "LICENSE").read_text()


def test_the_wheel_is_for_every_platform(wheel: Path) -> None:
    assert wheel.name == f"{NAME}-py3-none-any.whl"


def test_the_metadata_is_what_the_project_says(metadata: EmailMessage) -> None:
    assert metadata["Name"] == PROJECT["name"]
    assert metadata["Version"] == PROJECT["version"]
    assert metadata["Summary"] == PROJECT["description"]
    assert metadata["License-Expression"] == PROJECT["license"]
    assert metadata["Requires-Python"] == PROJECT["requires-python"]
    assert metadata.get_all("Classifier") == PROJECT["classifiers"]
    assert metadata.get_all("Provides-Extra") == sorted(PROJECT["optional-dependencies"])


def test_without_extras_nothing_but_the_two_dependencies_is_required(
    metadata: EmailMessage,
) -> None:
    required = metadata.get_all("Requires-Dist", [])
    assert [each for each in required if "extra ==" not in each] == PROJECT["dependencies"]


def without_marker(requirement: Requirement) -> str:
    """Return a requirement, whose marker may be that of a system, of an extra, or of both."""
    return f"{requirement.name}{sorted(requirement.extras)}{requirement.specifier}"


@pytest.mark.parametrize("extra", PROJECT["optional-dependencies"])
def test_an_extra_requires_what_it_names(metadata: EmailMessage, extra: str) -> None:
    extras = PROJECT["optional-dependencies"]
    wanted: list[str] = []
    for each in extras[extra]:
        wanted += extras["cli"] if each == f"{PROJECT['name']}[cli]" else [each]
    required = [Requirement(each) for each in metadata.get_all("Requires-Dist", [])]
    found = [each for each in required if each.marker and f'extra == "{extra}"' in str(each.marker)]
    assert sorted(map(without_marker, found)) == sorted(
        map(without_marker, map(Requirement, wanted))
    )


def test_the_readme_is_the_description_with_links_into_the_repository(
    metadata: EmailMessage,
) -> None:
    assert metadata["Description-Content-Type"] == "text/markdown"
    description = metadata.get_content()
    assert description.startswith("# fibaction\n")
    assert f"]({PROJECT['urls']['Repository']}/blob/v{PROJECT['version']}/docs/" in description
    assert "](docs/" not in description


def test_the_entry_points_are_those_of_the_project(wheel: Path) -> None:
    found = ConfigParser(delimiters="=")
    found.read_string(text(wheel, "entry_points.txt"))
    expected = {"console_scripts": PROJECT["scripts"], **PROJECT["entry-points"]}
    assert {name: dict(found[name]) for name in found.sections()} == expected


def test_the_sdist_has_all_that_a_packager_needs_and_nothing_else(sdist: Path) -> None:
    expected = {file for folder in FOLDERS for file in sources(ROOT / folder, ROOT)}
    with tarfile.open(sdist) as archive:
        found = {member.name.removeprefix(f"{NAME}/") for member in archive if member.isfile()}
    assert found == expected | FILES


def test_the_wheel_of_the_sdist_is_that_of_the_checkout(wheel: Path) -> None:
    assert wheel.read_bytes() == (ROOT / "build" / "checkout" / wheel.name).read_bytes()
