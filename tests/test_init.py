from __future__ import annotations

import ast
import inspect
import os
import re
import subprocess
import sys
from importlib import import_module

import pytest

import fibaction
import fibaction.blocking
from fibaction.words import errors as errors_module


def declared() -> dict[str, str]:
    """The names that type checkers see, and the modules that they are from."""
    body = ast.parse(inspect.getsource(fibaction)).body
    block = next(statement for statement in body if isinstance(statement, ast.If))
    imports = [one for one in block.body if isinstance(one, ast.ImportFrom)]
    return {alias.name: str(one.module) for one in imports for alias in one.names}


PUBLIC = sorted(declared())


def modules_after(code: str) -> set[str]:
    """The names of all modules that a new interpreter has imported when it has run this."""
    shown = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys\nprint(*sys.modules, sep='\\n')"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        check=True,
        text=True,
        timeout=30,
    )
    return set(shown.stdout.split())


def test_the_list_of_public_names_is_sorted_and_has_no_name_twice() -> None:
    assert fibaction.__all__ == sorted(set(fibaction.__all__))


def test_the_list_of_public_names_is_complete() -> None:
    assert fibaction.__all__ == PUBLIC
    assert set(PUBLIC) <= set(dir(fibaction))


@pytest.mark.parametrize(("name", "module"), declared().items())
def test_a_name_is_what_type_checkers_take_it_for(
    name: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(vars(fibaction), name, raising=False)  # as if it was not used before
    assert getattr(fibaction, name) is getattr(import_module(module), name)


def test_a_name_that_there_is_not_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'fibaction' has no attribute 'Robot'"):
        print(fibaction.Robot)  # type: ignore[attr-defined]  # as a program may have it by mistake


def test_a_client_does_not_import_the_server() -> None:
    imported = modules_after("from fibaction import Action, connect")
    assert "fibaction.client" in imported
    assert not any(name.startswith(("fibaction.server", "fibaction.stores")) for name in imported)


def test_an_import_of_the_package_alone_brings_no_other_module_of_it_but_its_version() -> None:
    imported = modules_after("import fibaction")
    assert {name for name in imported if name.startswith("fibaction")} == {
        "fibaction",
        "fibaction._runtime",
    }


def test_an_import_does_not_bring_what_looks_for_installed_packages() -> None:
    assert "importlib.metadata" not in modules_after("import fibaction")


def test_every_error_is_public() -> None:
    errors = {
        name
        for name, value in vars(errors_module).items()
        if inspect.isclass(value) and issubclass(value, BaseException) and name[0] != "_"
    }
    assert errors <= set(fibaction.__all__)


ALIASES = {"Executor"}
"""Names of types, which have no docstring at run time."""


@pytest.mark.parametrize("name", [name for name in PUBLIC if name not in ALIASES])
def test_a_public_name_and_its_members_have_docstrings(name: str) -> None:
    value = getattr(fibaction, name)
    assert value.__doc__
    if not inspect.isclass(value):
        return
    for member_name, member in vars(value).items():
        function = inspect.isroutine(member) or isinstance(member, property)
        if member_name[0] != "_" and function:
            # A method may have the docstring of the one that it overrides.
            assert inspect.getdoc(getattr(value, member_name)), f"{name}.{member_name}"


WITH_EXAMPLES = [
    *(fibaction.Action, fibaction.ActionServer, fibaction.Schedule, fibaction.GoalHandle),
    *(fibaction.connect, fibaction.serve, fibaction.ClientConnection, fibaction.ActionClient),
    *(fibaction.ClientGoal, fibaction.Events, fibaction.Retry, fibaction.GoalID),
    *(fibaction.Outcome, fibaction.Sender, fibaction.SqliteStore, fibaction.Limits),
    *(fibaction.blocking.connect, fibaction.blocking.BlockingClient),
    fibaction.blocking.BlockingGoal,
]
"""The public names that programs use themselves, each with an example in its docstring."""


@pytest.mark.parametrize("value", WITH_EXAMPLES, ids=lambda value: value.__qualname__)
def test_what_programs_use_has_an_example_of_valid_python(value: object) -> None:
    text = inspect.getdoc(value)
    assert text is not None
    examples = re.findall(r"\n\n((?:    .*\n|\n)+)", f"{text}\n")
    assert examples
    for example in examples:
        indented = "".join(f"    {line}\n" for line in example.strip("\n").splitlines())
        compile(f"async def example():\n{indented}", "docstring", "exec")


def test_an_import_brings_no_parser_of_action_files_which_has_a_module_of_its_own() -> None:
    imported = modules_after("from fibaction import *")
    assert {name for name in imported if name.startswith("fibaction.interfaces")} == set()
    assert "fibaction.interfaces" in modules_after("from fibaction.action_files import load_action")


def test_an_import_brings_no_transport_no_ros_and_no_event_loop() -> None:
    imported = modules_after("import fibaction.testing; from fibaction import *")
    assert "fibaction.server" in imported
    assert {name.partition(".")[0] for name in imported}.isdisjoint(
        {"fibaction_transports", "rclpy", "asyncio", "trio"}
    )
