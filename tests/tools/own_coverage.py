"""A check that each module is covered, lines and branches, by tests that one finds.

    python -m pytest -p tests.tools.own_coverage [FILE OR FOLDER...]

These are the tests of its unit, or those of whole servers and clients: the contract and the
simulations. `tests/tools/units.py` says where both are. So no line depends on a test of another
unit. This is a plugin of pytest, so that no test runs twice: it takes what the probes of the
modules say after each test file. The run fails if a module falls short all of whose tests are run.

coverage.py says which lines and branches a module has, and which need not be covered. It does not
measure here: its tracer made most tests take two to three times as long.
"""

from __future__ import annotations

import importlib
import json
import os
import random
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import pytest
from coverage import Coverage

from tests.tools.probes import Place, Probes
from tests.tools.units import modules, shared

PACKAGES = ("fibaction", "fibaction_transports")

IMPORTING = Path("importing")
"""The place of what runs when the modules are imported, which counts for all tests."""

Marks: TypeAlias = "dict[str, list[tuple[int, int | None]]]"
"""The places that were reached in each module."""


def dotted(module: Path) -> str:
    """Return a module's name, as imported."""
    names = [] if module.stem == "__init__" else [module.stem]
    while (module := module.parent).joinpath("__init__.py").exists():
        names.insert(0, module.name)
    return ".".join(names)


class Tracer:
    """Follows the tests that cover modules, in one process."""

    def __init__(self, root: Path) -> None:
        common = shared(root)
        self._modules = [(module, [*tests, *common]) for module, tests in modules(root)]
        self._tests = {test for _, tests in self._modules for test in tests}
        self._probes = Probes(*PACKAGES)
        self._found: dict[Path, dict[str, set[Place]]] = {}
        self._followed = IMPORTING
        self._test: Path | None = IMPORTING
        paths = [str(module) for module, _ in self._modules]
        # Processes begin at different places, so that each module is prepared by one of them.
        random.Random(os.environ.get("PYTEST_XDIST_WORKER")).shuffle(paths)
        self._probes.prepare(paths)
        # Else the test file that is the first to need a module would get its definitions.
        imported = [importlib.import_module(dotted(module)) for module, _ in self._modules]
        self._forgets: list[Callable[[], None]] = [
            value.cache_clear
            for module in imported
            for value in vars(module).values()
            if hasattr(value, "cache_clear")
        ]

    def follow(self, path: Path) -> None:
        """Count from now on for the tests at this path, if they cover a module."""
        if path != self._followed:
            self._followed = path
            self._take()
            # Else only the first test file that needs what is cached would reach the function.
            for forget in self._forgets:
                forget()
            is_wanted = path in self._tests or not self._tests.isdisjoint(path.parents)
            self._test = path if is_wanted else None

    def marks(self) -> Marks:
        """Return where the tests of each module have reached in it."""
        self._take()
        self._test = None
        marks: Marks = {}
        for module, tests in self._modules:
            own: set[Place] = set()
            for path, found in self._found.items():
                if path == IMPORTING or any(map(path.is_relative_to, tests)):
                    own |= found.get(str(module), set())
            marks[str(module)] = [(line, target) for line, target in own]
        return marks

    def _take(self) -> None:
        reached = self._probes.take()
        if self._test is not None:
            known = self._found.setdefault(self._test, {})
            for module, places in reached.items():
                known.setdefault(module, set()).update(places)


def gaps(report: dict[str, Any], reached: set[tuple[int, int | None]]) -> str:
    """Return the missing lines and branches.

    In the report each branch is missing, since coverage.py was told only of lines.
    """
    passed: dict[int, list[int]] = {}
    for line, target in reached:
        if target is not None and target < 0:
            passed.setdefault(line, []).append(-target)
    lines = [str(line) for line in report["missing_lines"]]
    # A branch out of a line that was not reached says nothing new; a negative one is an exit.
    branches = [
        f"{start}->{end if end > 0 else 'exit'}"
        for start, end in report["missing_branches"]
        if start not in report["missing_lines"]
        and (start, end) not in reached
        and all(end == first for first in passed.get(start, []))
    ]
    return ", ".join(lines + branches)


class Gathering:
    """The gatherer of what all processes have reached."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._reached: dict[str, set[tuple[int, int | None]]] = {}
        self._lines: list[str] = []

    def add(self, marks: Marks) -> None:
        """Add what one process has reached."""
        for module, found in marks.items():
            self._reached.setdefault(module, set()).update((line, end) for line, end in found)

    def shortcomings(self) -> Iterator[str]:
        """Yield each module that falls short, and where; of those all of whose tests are run."""
        root = self._config.rootpath
        asked = [root / argument.partition("::")[0] for argument in self._config.args]
        looked_at: list[Path] = []
        for module, tests in modules(root):
            missing = [test for test in tests if not test.exists()]
            for test in missing:
                yield f"{module.relative_to(root)}: there is no {test.relative_to(root)}"
            needed = [*tests, *shared(root)]
            if not missing and all(any(map(test.is_relative_to, asked)) for test in needed):
                looked_at.append(module)
        for name, gaps_ in self._uncovered(looked_at).items():
            if gaps_:
                yield f"{name}: {gaps_}"

    def _uncovered(self, looked_at: list[Path]) -> dict[str, str]:
        """Return what was not reached, for each module."""
        if not looked_at:
            return {}
        coverage = Coverage(
            data_file=None, config_file=str(self._config.rootpath / "pyproject.toml")
        )
        # Arcs from nowhere: coverage.py takes branches by arcs only, and the lines from these.
        coverage.get_data().add_arcs(
            {module: {(-1, line) for line, _ in found} for module, found in self._reached.items()}
        )
        with TemporaryDirectory() as folder:
            report = Path(folder) / "report.json"
            coverage.json_report([str(module) for module in looked_at], outfile=str(report))
            files: dict[str, Any] = json.loads(report.read_text())["files"]
        return {
            module: gaps(found, self._reached[str(self._config.rootpath / module)])
            for module, found in files.items()
        }

    def pytest_testnodedown(self, node: Any) -> None:
        """Take what a process of pytest-xdist hands over when it ends."""
        self.add(getattr(node, "workeroutput", {}).get("own_coverage", {}))

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if session.exitstatus != pytest.ExitCode.OK:
            self._lines = ["own coverage is not looked at when tests fail"]
        elif short := list(self.shortcomings()):
            self._lines = ["not covered by the tests of their units, or of whole servers:", *short]
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        else:
            self._lines = ["each module is covered by the tests of its unit, or of whole servers"]

    @pytest.hookimpl(tryfirst=True)
    def pytest_unconfigure(self, config: pytest.Config) -> None:
        # After all that pytest writes, where a reader of the end of a long log looks.
        reporter: pytest.TerminalReporter | None = config.pluginmanager.get_plugin(
            "terminalreporter"
        )
        if reporter is not None:
            for line in self._lines:
                reporter.write_line(line)


class Following:
    """Tells the tracer whose tests run, and hands over what it found."""

    def __init__(self, tracer: Tracer) -> None:
        self._tracer = tracer

    @pytest.hookimpl(wrapper=True)
    def pytest_make_collect_report(
        self, collector: pytest.Collector
    ) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
        self._tracer.follow(collector.path)
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        self._tracer.follow(item.path)
        return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Generator[None]:
        marks = self._tracer.marks()
        if gathering := session.config.pluginmanager.get_plugin("own_coverage_gathering"):
            gathering.add(marks)
        else:
            session.config.workeroutput["own_coverage"] = marks  # type: ignore[attr-defined]  # of pytest-xdist
        return (yield)


_TRACER = pytest.StashKey[Tracer]()


def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Begin to trace, before anything imports a module."""
    if is_worker() or not early_config.known_args_namespace.numprocesses:
        early_config.stash[_TRACER] = Tracer(early_config.rootpath)


def pytest_configure(config: pytest.Config) -> None:
    """Follow the tests where they run, and gather where all ends."""
    if tracer := config.stash.get(_TRACER, None):
        config.pluginmanager.register(Following(tracer), "own_coverage_following")
    if not is_worker():
        config.pluginmanager.register(Gathering(config), "own_coverage_gathering")


def is_worker() -> bool:
    """Is this a process that pytest-xdist made to run tests?"""
    return "PYTEST_XDIST_WORKER" in os.environ
