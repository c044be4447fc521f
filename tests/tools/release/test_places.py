"""The places of the version: each is known, and is replaced alone."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from tests.tools.release.places import files, series_of, versions_in, with_version

ROOT = Path(__file__).resolve().parents[3]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
OF_SOMETHING_ELSE = (
    "CHANGELOG.md",  # each version, by its section
    "docs/benchmarks/",  # measured with it
    "docs/comparisons.md",  # the same
    "docs/contributing.md",  # an example of a command
    "docs/figures/",  # measured with it
    "docs/first_action.md",  # of the package on the page
    "docs/shown_to_hold.md",  # measured with it
    "examples/ros2/",  # of packages that are built by colcon
    "tests/",
)
"""Files, and folders, in which the text of the version is not the version of the project."""


def text_of(file: str) -> str:
    return (ROOT / file).read_text(encoding="utf-8")


@pytest.mark.parametrize("file", sorted(files()))
def test_a_place_has_the_version_of_the_project(file: str) -> None:
    full = versions_in(file, text_of(file))
    assert full <= {(VERSION, False), (series_of(VERSION), True)}
    assert full


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="an sdist has no list of its sources")
def test_no_other_file_has_the_version_of_the_project() -> None:
    named = re.compile(rf"(?<![\d.]){re.escape(VERSION)}(?![\d.]*\d)")
    kinds = ("*.cff", "*.json", "*.md", "*.py", "*.toml")
    command = ["git", "-C", str(ROOT), "ls-files", *kinds]
    listed = subprocess.run(command, capture_output=True, text=True, check=True)
    found = {
        file
        for file in listed.stdout.splitlines()
        if not file.startswith(OF_SOMETHING_ELSE) and named.search(text_of(file))
    }
    assert found <= files()


def test_only_the_version_is_replaced() -> None:
    text = 'name = "x"\nversion = "0.1.0"  \nversion = "0.1.0"\nneeds = "0.1.0"\n'

    changed = with_version("pyproject.toml", text, "0.2.0")

    assert changed == 'name = "x"\nversion = "0.1.0"  \nversion = "0.2.0"\nneeds = "0.1.0"\n'


@pytest.mark.parametrize("text", ["", 'version = "0.1.0"\nversion = "0.1.0"\n'])
def test_a_place_that_is_gone_or_twice_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match=r"^pyproject.toml has [02] lines .*, and has to have one"):
        with_version("pyproject.toml", text, "0.2.0")
