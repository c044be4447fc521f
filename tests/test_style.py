"""The rules of style that no linter knows: words and names in docstrings, gerunds, loggers.

`test_structure.py` has the rules about names that occur twice, and about sizes.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Set
from pathlib import Path

from tests.tools.units import CONTRACT

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ("fibaction", "transports")
QUESTION_WORDS = ("what", "whether", "who", "whose", "how", "where", "when", "why")


def modules() -> Iterator[Path]:
    for source in SOURCES:
        for path in sorted((ROOT / source).rglob("*.py")):
            if not path.is_relative_to(ROOT / CONTRACT):
                yield path


def docstrings(tree: ast.Module) -> Iterator[str]:
    """Yield every docstring of a module, those of fields included."""
    for node in ast.walk(tree):
        match node:
            case ast.Expr(ast.Constant(str() as text)):
                yield text.strip()


def questions(module: Path) -> list[str]:
    """Return the docstrings of a module that begin with a question word."""
    texts = docstrings(ast.parse(module.read_text()))
    return [text for text in texts if text.lower().split(" ")[0] in QUESTION_WORDS]


def test_no_docstring_begins_with_a_question_word() -> None:
    found = {str(module.relative_to(ROOT)): questions(module) for module in modules()}
    assert {name: texts for name, texts in found.items() if texts} == {}


NOUNS = ("testing", "greeting", "string", "setting", "heading", "warning", "recording", "mapping")
"""Words in -ing that name things, and not what is done."""


def test_no_module_is_named_by_a_gerund() -> None:
    named = {module.stem.strip("_") for module in modules()}
    assert {name for name in named if name.endswith("ing") and not name.endswith(NOUNS)} == set()


def duty(text: str) -> str:
    """Return the first paragraph of a docstring."""
    return text.partition("\n\n")[0].replace("\n", " ")


def test_each_module_has_one_duty_which_its_first_sentence_tells() -> None:
    duties = {
        str(module.relative_to(ROOT)): duty(ast.get_docstring(ast.parse(module.read_text())) or "")
        for module in modules()
    }
    wrong = {
        name: text
        for name, text in duties.items()
        if not re.fullmatch(r"[^.!?]+(?:[.!?]\S[^.!?]*)*\.", text)
    }
    assert wrong == {}, "one sentence, and then an empty line"


FOREIGN = {
    # Packages, interfaces and parts of ROS, and of the protocols that it is used with.
    "action_status",
    "event_message",
    "nav_msgs",
    "navigate_to_pose",
    "rcl_action",
    "sensor_msgs",
    # Names of SQLite, of a table in a file, and of NATS.
    "handshake_first",
    "needs_log",
    "wal_autocheckpoint",
}
"""Names of other software that docstrings mention, and that no code has."""

_NAME = re.compile(r"(?<!`)`([a-z_]\w*(?:\.\w+)*)`(?!`)")
_WORDS = re.compile(r"[\w./]+")
_POINTER = re.compile(r"\b[Ss]ee\s+`([a-z_][\w.]*)`")


def names_in(tree: ast.Module) -> set[str]:
    """Return the names that the code of a module has, and the words of its texts without spaces."""
    texts = {text for node in ast.walk(tree) for text in vars(node).values() if type(text) is str}
    return {name for text in texts if _WORDS.fullmatch(text) for name in re.findall(r"\w+", text)}


def unknown_names(text: str, known: Set[str]) -> list[str]:
    """Return the names in a docstring that nothing has. Only those with an underscore are looked
    at: other ones may be words of Python, or values.
    """
    names = [name.rpartition(".")[2] for name in _NAME.findall(text) if "_" in name]
    return [name for name in names if name not in known]


def unknown_pointers(text: str, modules: Set[str]) -> list[str]:
    """Return the names after "see" in the docstring of a module that are not modules."""
    return [
        name
        for name in _POINTER.findall(text)
        if not modules & {name.partition(".")[0], name.rpartition(".")[2]}
    ]


def test_docstrings_name_only_what_there_is() -> None:
    known = {name for module in modules() for name in (module.stem, module.parent.name)}
    stems, texts = frozenset(known), dict[Path, tuple[str, list[str]]]()
    for module in modules():
        tree = ast.parse(module.read_text())
        known |= names_in(tree)
        texts[module] = ast.get_docstring(tree) or "", [*docstrings(tree)]
    assert known & FOREIGN == set()
    known |= FOREIGN
    found = {
        str(module.relative_to(ROOT)): [
            *(name for text in fields for name in unknown_names(text, known)),
            *unknown_pointers(first, stems),
        ]
        for module, (first, fields) in texts.items()
    }
    assert {name: unknown for name, unknown in found.items() if unknown} == {}


def test_a_name_and_a_pointer_to_a_module_that_is_gone_are_found() -> None:
    text = "See `goal`, see `_gone.leave` and `old_name`; `Class`, `await` and `new_name` are fine."
    assert unknown_names(text, {"new_name", "leave"}) == ["old_name"]
    assert unknown_pointers(text, {"goal"}) == ["_gone.leave"]


CLEAN_LOGS = (
    "fibaction/_runtime/log.py",
    "fibaction/cli/output/lines.py",
    "fibaction/cli/verbs/overview.py",
    "fibaction/server/log_keeper.py",
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
