"""Probes: what they reach is what coverage.py's tracer says, for each kind of statement."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import anyio
import pytest
from coverage import Coverage

from tests.tools import probes as tool
from tests.tools.own_coverage import gaps
from tests.tools.probes import Probes

PROGRAM = '''"""A docstring."""

from __future__ import annotations

import functools


class Kept:
    """A docstring."""

    number: int = 0

    @functools.cached_property
    def twice(self) -> int:
        return self.number * 2


async def choose(value):
    """A docstring."""
    global last
    if value == 1:
        last = "one"
    elif value == 2:
        last = "two"
    for number in range(value):
        if number == 5:
            break
    else:
        last = "whole"
    for number in range(value):
        last = str(number)
    while value > 3:
        value -= 1
    while True:
        if last != "whole":
            break
        last = "again"
    try:
        if value == 0:
            raise KeyError(value)
        if value == 1:
            raise ValueError(value)
    except KeyError:
        last = "key"
    except (TypeError, ValueError):
        last = "value"
    else:
        last = "none"
    finally:
        value += 1
    match value:
        case 1:
            last = "first"
        case 2 if last == "value":
            last = "second"
    return last
'''


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The place of a program that can be imported."""
    path = tmp_path / "a_probed_program.py"
    path.write_text(PROGRAM)
    monkeypatch.syspath_prepend(tmp_path)
    yield path
    sys.modules.pop(path.stem, None)


@pytest.fixture
def probes(path: Path) -> Iterator[Probes]:
    probes = Probes(path.stem)
    yield probes
    sys.meta_path.remove(probes)


def use(module: ModuleType, values: list[int]) -> None:
    for value in values:
        anyio.run(module.choose, value)


def report(path: Path, coverage: Coverage) -> dict[str, Any]:
    """Return what coverage.py reports of the program."""
    out = path.with_suffix(".json")
    coverage.json_report([str(path)], outfile=str(out))
    (found,) = json.loads(out.read_text())["files"].values()
    assert isinstance(found, dict)
    return found


def test_what_is_imported_and_what_is_called_later_are_told_apart(
    path: Path, probes: Probes
) -> None:
    module = importlib.import_module(path.stem)
    line = PROGRAM.splitlines().index("        return self.number * 2") + 1
    assert line not in {place.line for place in probes.take()[str(path)]}

    assert module.Kept().twice == 0
    assert {place.line for place in probes.take()[str(path)]} == {line}
    assert probes.take() == {}


def test_code_is_made_once_for_each_text_of_a_module(
    path: Path, probes: Probes, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    class Counted(tool.Placement):
        def __init__(self) -> None:
            super().__init__()
            made.append(path.read_text())

    monkeypatch.setattr(tool, "Placement", Counted)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    probes.prepare([str(path)])
    probes.prepare([str(path)])
    use(importlib.import_module(path.stem), [1])
    assert made == [PROGRAM]
    from_kept = probes.take()

    path.write_text(f"{PROGRAM}\n")
    del sys.modules[path.stem]
    use(importlib.import_module(path.stem), [1])
    assert made == [PROGRAM, f"{PROGRAM}\n"]
    assert probes.take() == from_kept


@pytest.mark.parametrize("values", [[], [0], [1], [2], [3], [4], [9], [0, 1, 2, 3, 4, 9]])
def test_lines_and_branches_are_those_that_a_tracer_sees(
    path: Path, probes: Probes, values: list[int]
) -> None:
    use(importlib.import_module(path.stem), values)
    reached: set[tuple[int, int | None]] = {*probes.take()[str(path)]}
    told = Coverage(data_file=None, config_file=False, branch=True)
    told.get_data().add_arcs({str(path): {(-1, line) for line, _ in reached}})

    traced = Coverage(data_file=None, config_file=False, branch=True, include=[str(path)])
    module = ModuleType("traced")
    with traced.collect():
        exec(compile(PROGRAM, path, "exec"), vars(module))
        use(module, values)

    assert gaps(report(path, told), reached) == gaps(report(path, traced), set())
