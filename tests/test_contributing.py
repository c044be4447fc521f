"""The pages for those who work on the project: what they name is there."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from tests.support.page_parts import part_of
from tests.tools import package_table

ROOT = Path(__file__).resolve().parent.parent
PAGES = ["CONTRIBUTING.md", "docs/contributing.md"]
MAKEFILE = (ROOT / "Makefile").read_text()
COMMANDS = set(MAKEFILE.replace("\\\n", "").partition(".PHONY: ")[2].partition("\n")[0].split())


@pytest.mark.parametrize("page", PAGES)
def test_each_make_command_that_a_page_names_is_one(page: str) -> None:
    named = re.findall(r"(?:`|\$ )make ([a-z-]+)", (ROOT / page).read_text())
    assert named
    assert set(named) <= COMMANDS


def test_each_make_command_is_told_of_by_make_help() -> None:
    told = re.findall(r"^([a-z-]+):.*## ", MAKEFILE, re.MULTILINE)
    assert set(told) == COMMANDS


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


# The packages


def test_each_package_begins_with_its_duty_in_one_sentence() -> None:
    assert package_table.faults(package_table.duties()) == []


def test_the_table_of_packages_is_that_of_the_tree() -> None:
    page = package_table.PAGE.read_text(encoding="utf-8")
    table = part_of(page, "packages", package_table.MAKER)
    assert table == package_table.table(package_table.duties()), (
        "write it with `python -m tests.tools.package_table`"
    )


def test_every_folder_with_an_init_is_a_package_of_the_table(tmp_path: Path) -> None:
    for folder, docstring in {
        "": "The top.",
        "wire": "The wire.\n\nMore.",
        "wire/empty": "",
    }.items():
        (tmp_path / "fibaction" / folder).mkdir(parents=True)
        text = f'"""{docstring}"""\n' if docstring else ""
        (tmp_path / "fibaction" / folder / "__init__.py").write_text(text)
    (tmp_path / "fibaction" / "console").mkdir()
    duties = package_table.duties(tmp_path)
    assert duties == {
        "fibaction/": "The top.",
        "fibaction/wire/": "The wire.",
        "fibaction/wire/empty/": "",
    }
    assert package_table.faults(duties) == [
        "fibaction/wire/empty/ has no docstring: state its duty in one sentence"
    ]


@pytest.mark.parametrize("duty", ["The wire", "The wire\nprotocol.", "The wire. And more."])
def test_a_duty_is_one_sentence_on_one_line(duty: str) -> None:
    assert len(package_table.faults({"fibaction/wire/": duty})) == 1


def test_each_scheme_of_a_transport_is_told_of_on_the_page_of_transports() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    page = (ROOT / "docs/transports.md").read_text()
    schemes = project["entry-points"]["fibaction.transports"]
    assert [scheme for scheme in schemes if f"`{scheme}:" not in page] == []
