"""A check that each module is covered, lines and branches, by the tests that belong to it.

    python -m pytest -p tests.tools.own_coverage [FILE OR FOLDER...]

`tests/tools/units.py` says which tests belong to a module: its own test file, or those of its unit.
So no line depends on a test that lies elsewhere. This is a plugin of pytest, so that no test runs
twice: it traces each test file apart from the others. The run fails if a module falls short all of
whose tests are run.
"""

from __future__ import annotations

import importlib
import json
import os
import re
from collections.abc import Generator, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import pytest
from coverage import Coverage

from tests.tools.units import modules

IMPORTING = "importing"
"""The context of what runs when the modules are imported, which counts for all tests."""

Arcs: TypeAlias = "dict[str, list[tuple[int, int]]]"
"""The steps of the interpreter in each module, from line to line."""


def dotted(module: Path) -> str:
    """Return a module's name, as imported."""
    names = [] if module.stem == "__init__" else [module.stem]
    while (module := module.parent).joinpath("__init__.py").exists():
        names.insert(0, module.name)
    return ".".join(names)


class Tracer:
    """Traces the tests that cover modules, in one process."""

    def __init__(self, root: Path) -> None:
        # The tracers that replace this one from Python 3.12 on tell each line once, for whichever
        # file comes first.
        os.environ["COVERAGE_CORE"] = "ctrace"
        self._modules = list(modules(root))
        self._tests = {test for _, tests in self._modules for test in tests}
        self._coverage = Coverage(data_file=None, config_file=str(root / "pyproject.toml"))
        self._traced: str | None = None
        # Else the test file that is the first to need a module would get its definitions.
        self._trace(IMPORTING)
        for module, _ in self._modules:
            importlib.import_module(dotted(module))
        self._trace(None)

    def follow(self, path: Path) -> None:
        """Trace from now on, if the tests at this path cover a module."""
        is_wanted = path in self._tests or not self._tests.isdisjoint(path.parents)
        self._trace(str(path) if is_wanted else None)

    def arcs(self) -> Arcs:
        """Return where the tests of each module have reached in it."""
        self._trace(None)
        data = self._coverage.get_data()
        found: Arcs = {}
        for module, tests in self._modules:
            own = [f"^{re.escape(str(test))}(/|$)" for test in tests]
            data.set_query_contexts([f"^{IMPORTING}$", *own])
            found[str(module)] = data.arcs(str(module)) or []
        return found

    def _trace(self, test: str | None) -> None:
        if test == self._traced:
            return
        if self._traced is None:
            self._coverage.start()
        if test is None:
            self._coverage.stop()
        else:
            self._coverage.switch_context(test)
        self._traced = test


def gaps(report: dict[str, Any]) -> str:
    """Return the lines and branches that coverage.py reports as missing."""
    lines = [str(line) for line in report["missing_lines"]]
    # A branch out of a line that was not reached says nothing new; a negative one is an exit.
    branches = [
        f"{start}->{end if end > 0 else 'exit'}"
        for start, end in report["missing_branches"]
        if start not in report["missing_lines"]
    ]
    return ", ".join(lines + branches)


class Gathering:
    """The gatherer of the arcs of all processes."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._arcs: dict[str, set[tuple[int, int]]] = {}
        self._lines: list[str] = []

    def add(self, arcs: Arcs) -> None:
        """Add the arcs of one process."""
        for module, found in arcs.items():
            self._arcs.setdefault(module, set()).update((start, end) for start, end in found)

    def shortcomings(self) -> Iterator[str]:
        """Yield each module that falls short, and where; of those all of whose tests are run."""
        root = self._config.rootpath
        asked = [root / argument.partition("::")[0] for argument in self._config.args]
        looked_at: list[Path] = []
        for module, tests in modules(root):
            missing = [test for test in tests if not test.exists()]
            for test in missing:
                yield f"{module.relative_to(root)}: there is no {test.relative_to(root)}"
            if not missing and all(any(map(test.is_relative_to, asked)) for test in tests):
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
        coverage.get_data().add_arcs(self._arcs)
        with TemporaryDirectory() as folder:
            report = Path(folder) / "report.json"
            coverage.json_report([str(module) for module in looked_at], outfile=str(report))
            files: dict[str, Any] = json.loads(report.read_text())["files"]
        return {module: gaps(found) for module, found in files.items()}

    def pytest_testnodedown(self, node: Any) -> None:
        """Take the arcs that a process of pytest-xdist hands over when it ends."""
        self.add(getattr(node, "workeroutput", {}).get("own_coverage", {}))

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if session.exitstatus != pytest.ExitCode.OK:
            self._lines = ["own coverage is not looked at when tests fail"]
        elif short := list(self.shortcomings()):
            self._lines = ["not covered by their own tests:", *short]
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        else:
            self._lines = ["each module is covered by its own tests"]

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
        arcs = self._tracer.arcs()
        if gathering := session.config.pluginmanager.get_plugin("own_coverage_gathering"):
            gathering.add(arcs)
        else:
            session.config.workeroutput["own_coverage"] = arcs  # type: ignore[attr-defined]  # of pytest-xdist
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
