"""ARCHITECTURE.md: its links lead to files, its table of rules names modules with their theory, and
its map is the order that import-linter checks.
"""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_link_leads_to_a_file() -> None:
    targets = [each.partition("#")[0] for each in re.findall(r"\]\(([^)]+)\)", PAGE)]
    assert len(targets) > 50
    assert [each for each in targets if not (ROOT / each).exists()] == []


def test_a_link_to_a_module_is_named_as_the_file_or_by_what_is_in_it() -> None:
    for name, target in re.findall(r"\[`?([\w./]+?)`?\]\(([^)#]+\.py)\)", PAGE):
        code = (ROOT / target).read_text(encoding="utf-8")
        assert target.endswith(name) or f"class {name}" in code or name in Path(target).stem, name


def test_each_rule_has_one_file_which_is_there_and_has_a_docstring() -> None:
    table = PAGE.partition("## Where is the rule?\n")[2].partition("\n## ")[0]
    header, _, *rows = [line for line in table.splitlines() if line.startswith("|")]
    assert header == "| The question | The file |"
    questions = set()
    for row in rows:
        found = re.fullmatch(r"\| ([^|]+\?) \| \[([\w/.]+)\]\(([\w/.]+)\) \|", row)
        assert found is not None, row
        question, name, target = found.groups()
        assert target.endswith(f"/{name}"), row
        assert ast.get_docstring(ast.parse((ROOT / target).read_text(encoding="utf-8"))), row
        questions.add(question)
    assert len(questions) == len(rows) > 30


def test_the_map_has_the_layers_in_their_order() -> None:
    contracts = PROJECT["tool"]["importlinter"]["contracts"]
    (layers,) = (one["layers"] for one in contracts if one["name"] == "imports point one way")
    packages = [
        name.removeprefix("fibaction.")
        for layer in layers
        for name in layer.split(" | ")
        if (ROOT / name.replace(".", "/")).is_dir()
    ]
    drawing = PAGE.partition("```text\n")[2].partition("```")[0]
    rows = [row[:30] for row in drawing.splitlines()]
    places = {
        name: next((n for n, row in enumerate(rows) if re.search(rf"\b{name}\b", row)), None)
        for name in packages
    }
    assert None not in places.values(), places
    order = [places[name] for name in packages]
    assert order == sorted(order, key=lambda place: place or 0)


def test_the_page_is_reached_from_the_first_pages() -> None:
    for page in ("README.md", "CONTRIBUTING.md"):
        assert "(ARCHITECTURE.md)" in (ROOT / page).read_text(encoding="utf-8"), page
