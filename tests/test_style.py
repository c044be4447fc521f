"""The rules of style that no linter knows: the words of docstrings, gerunds, loggers.

`test_structure.py` has the rules about names that occur twice, and about sizes.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ("fibaction", "transports")
QUESTION_WORDS = ("what", "whether", "who", "whose", "how", "where", "when", "why")


def modules() -> Iterator[Path]:
    for source in SOURCES:
        yield from sorted((ROOT / source).rglob("*.py"))


def docstrings(module: Path) -> Iterator[str]:
    """Yield every docstring of a module, those of fields included."""
    for node in ast.walk(ast.parse(module.read_text())):
        match node:
            case ast.Expr(ast.Constant(str() as text)):
                yield text.strip()


def questions(module: Path) -> list[str]:
    """Return the docstrings of a module that begin with a question word."""
    return [text for text in docstrings(module) if text.lower().split(" ")[0] in QUESTION_WORDS]


def test_no_docstring_begins_with_a_question_word() -> None:
    found = {str(module.relative_to(ROOT)): questions(module) for module in modules()}
    assert {name: texts for name, texts in found.items() if texts} == {}


def test_no_module_is_named_by_a_gerund() -> None:
    gerunds = {module.stem.strip("_") for module in modules() if module.stem.endswith("ing")}
    assert gerunds == {"testing"}


CLEAN_LOGS = (
    "fibaction/_runtime/log.py",
    "fibaction/cli/process/logs.py",
    "fibaction/cli/verbs/top.py",
)
"""The modules that set up logs, and so may use any logger."""


def test_every_logger_is_a_clean_one() -> None:
    found = {
        str(module.relative_to(ROOT)): node.lineno
        for module in modules()
        for node in ast.walk(ast.parse(module.read_text()))
        if isinstance(node, ast.Attribute | ast.alias)
        and (node.attr if isinstance(node, ast.Attribute) else node.name) == "getLogger"
    }
    assert {name: line for name, line in found.items() if name not in CLEAN_LOGS} == {}
