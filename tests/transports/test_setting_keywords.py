"""The settings of all transports: each is written once, and known wherever it has to be."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest

from fibaction.wire.transport import ConfiguredTransport
from fibaction_transports import keywords
from tests.tools.setting_keywords import WRITTEN, made, settings_of_transports
from tests.typing import settings

TRANSPORTS = {
    name: value
    for name, value in vars(settings).items()
    if isinstance(value, type) and issubclass(value, ConfiguredTransport)
}


def used() -> dict[str, set[str]]:
    """The keywords that the program for type checkers gives to each function, and to each class."""
    found: dict[str, set[str]] = {}
    for node in ast.walk(ast.parse(Path(str(settings.__file__)).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            names = found.setdefault(ast.unparse(node.func), set())
            for one in node.keywords:
                names.update([one.arg] if one.arg else getattr(settings, ast.unparse(one.value)))
    return found


def test_the_keyword_arguments_for_type_checkers_are_those_of_the_settings() -> None:
    assert WRITTEN.read_text(encoding="utf-8") == made(), (
        "write them: python -m tests.tools.setting_keywords"
    )


def test_the_program_for_type_checkers_has_every_transport() -> None:
    known = {transport.settings_type for transport in TRANSPORTS.values()}
    assert known == set(settings_of_transports())


@pytest.mark.parametrize("name", TRANSPORTS)
def test_the_program_for_type_checkers_uses_every_setting_of_a_transport(name: str) -> None:
    assert used()[name] >= set(TRANSPORTS[name].settings_type.__struct_fields__)


@pytest.mark.parametrize(
    ("function", "known"),
    [("connect", keywords.ConnectKeywords), ("serve", keywords.ServeKeywords)],
)
def test_the_program_for_type_checkers_uses_every_setting_of_a_url(
    function: str, known: Any
) -> None:
    assert used()[function] >= set(known.__annotations__)
