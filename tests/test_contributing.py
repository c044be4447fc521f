"""The pages for those who work on the project: what they name is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = ["CONTRIBUTING.md", "docs/contributing.md"]
MAKEFILE = (ROOT / "Makefile").read_text()
COMMANDS = re.search(r"^\.PHONY: (.*)$", MAKEFILE, re.MULTILINE)


@pytest.mark.parametrize("page", PAGES)
def test_each_make_command_that_a_page_names_is_one(page: str) -> None:
    assert COMMANDS is not None
    named = re.findall(r"(?:`|\$ )make ([a-z-]+)", (ROOT / page).read_text())
    assert named
    assert set(named) <= set(COMMANDS[1].split())


def test_each_make_command_is_told_of_by_make_help_or_is_a_part_of_make_test() -> None:
    assert COMMANDS is not None
    told = re.findall(r"^([a-z-]+):.*## ", MAKEFILE, re.MULTILINE)
    parts = re.search(r"^test: (.*?)  ##", MAKEFILE, re.MULTILINE)
    assert parts is not None
    assert set(COMMANDS[1].split()) == {*told, *parts[1].split()}


@pytest.mark.parametrize("page", PAGES)
def test_each_file_that_a_page_names_is_there(page: str) -> None:
    named = re.findall(
        r"`((?:docs|examples|fibaction|tests|transports)/[\w./-]*)`", (ROOT / page).read_text()
    )
    assert named
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_layers_on_the_page_are_all_modules() -> None:
    page = (ROOT / "docs/contributing.md").read_text()
    table = page.partition("## The layers")[2].partition("## ")[0]
    named = [
        name
        for row in re.findall(r"^\| [A-Z]\w+ \| (`.*?) \|", table, re.MULTILINE)
        for name in re.findall(r"`(\w+)`", row)
    ]
    there = {
        each.stem
        for each in (ROOT / "fibaction").iterdir()
        if (each.suffix == ".py" or (each / "__init__.py").exists())
        and not each.stem.startswith("_")
    }
    assert set(named) == there
