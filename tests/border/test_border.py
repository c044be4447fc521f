"""The border for authors of transports: it is documented, our transports use nothing else, and its
budgets count bytes.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import tomllib
from pathlib import Path
from typing import Any, cast

import pytest

import fibaction
from fibaction import Watcher, border
from fibaction.border.byte_budgets import ByteBudget, CountedBytes
from fibaction.server.watchers import METHODS

ROOT = Path(__file__).parents[2]
MODULES = {module.name for module in pkgutil.iter_modules(border.__path__)}
INTERFACES = {
    *("abc", "endpoints", "goal_store", "streams", "urls", "watchers"),
    "gateway",
}
"""The modules whose names are public in `fibaction`, in `fibaction.border.abc`, or not yet."""
HELPERS = sorted(MODULES - INTERFACES)
OPEN = {
    *("border", "feeds", "schema", "types", "wire", "words"),
    # The public names of modules in these.
    "ros_types",
}
"""The modules of fibaction that a transport may import."""


def contract(name: str) -> dict[str, Any]:
    """Return a contract of import-linter."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts: list[dict[str, Any]] = project["tool"]["importlinter"]["contracts"]
    return next(one for one in contracts if one["name"] == name)


def test_every_other_module_is_closed_to_transports() -> None:
    there = {module.name for module in pkgutil.iter_modules(fibaction.__path__)}
    closed = contract("transports import only what a foreign one may")["forbidden_modules"]
    assert {f"fibaction.{name}" for name in there - OPEN} == set(closed)
    assert there >= OPEN


@pytest.mark.parametrize("name", HELPERS)
def test_a_module_of_the_border_is_in_the_guide_and_the_reference(name: str) -> None:
    for page in ("transports/README.md", "docs/reference/border.md"):
        assert f"fibaction.border.{name}" in (ROOT / page).read_text(encoding="utf-8"), page


def test_the_package_tells_its_modules() -> None:
    assert {name for name in MODULES if f"`{name}`" in (border.__doc__ or "")} == MODULES


@pytest.mark.parametrize("name", HELPERS)
def test_the_names_of_a_module_of_the_border_are_documented(name: str) -> None:
    module = importlib.import_module(f"fibaction.border.{name}")
    assert module.__doc__
    for public in module.__all__:
        value = getattr(module, public)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), public


@pytest.mark.parametrize("name", METHODS)
def test_a_method_that_is_not_overridden_does_nothing(name: str) -> None:
    method = getattr(Watcher(), name)
    nothing = cast("Any", None)

    assert method(*[nothing] * (method.__code__.co_argcount - 1)) is None


def test_a_budget_has_room_up_to_its_limit() -> None:
    budget = ByteBudget(10)

    budget.take(4)

    assert budget.has_room(6)
    assert not budget.has_room(7)


def test_bytes_count_as_long_as_anything_references_them() -> None:
    budget = ByteBudget(10)
    counted = CountedBytes(budget, 4)
    other = counted

    del counted
    assert budget.used == other.size == 4

    del other
    assert budget.used == 0


def test_bytes_that_become_others_count_anew() -> None:
    budget = ByteBudget(10)
    counted = CountedBytes(budget, 4)

    counted.resize(7)
    assert budget.used == counted.size == 7

    del counted
    assert budget.used == 0
