"""Is each module covered, lines and branches, by its own test file alone?

    python -m pytest -p tests.own_coverage [FILE...]

So no line depends on a test that lies elsewhere, where nobody who changes the module looks. This is
a plugin of pytest, so that no test runs twice: it traces the test files that modules have of their
own, each apart from the others, and no other test. The run fails if a module whose test file is run
falls short.
"""

from __future__ import annotations

import ast
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

SOURCES = {"fibaction": "tests", "transports/fibaction_transports": "tests/transports"}
ELSEWHERE = "transports/fibaction_transports/ros2"  # needs ROS 2: `make test-ros`
IMPORTING = "importing"
"""What runs when the modules are imported, which one test file does for all in its process."""

Arcs: TypeAlias = "dict[str, list[tuple[int, int]]]"
"""Where the interpreter went, per module: from line to line."""


def modules(root: Path) -> Iterator[tuple[Path, Path]]:
    """Each module, and its own test file."""
    for source, tests in SOURCES.items():
        for module in sorted((root / source).rglob("*.py")):
            if module.is_relative_to(root / ELSEWHERE):
                continue
            if len(ast.parse(module.read_text()).body) > 1:  # more than a docstring
                name = f"test_{module.stem.strip('_')}.py"
                yield module, root / tests / module.relative_to(root / source).with_name(name)


def dotted(module: Path) -> str:
    """A module's name, as imported."""
    names = [] if module.stem == "__init__" else [module.stem]
    while (module := module.parent).joinpath("__init__.py").exists():
        names.insert(0, module.name)
    return ".".join(names)


class Tracer:
    """Traces the test files that modules have of their own, in one process."""

    def __init__(self, root: Path) -> None:
        # The tracers that replace this one from Python 3.12 on tell each line once, for whichever
        # file comes first.
        os.environ["COVERAGE_CORE"] = "ctrace"
        self._modules = {str(test): str(module) for module, test in modules(root)}
        self._coverage = Coverage(data_file=None, config_file=str(root / "pyproject.toml"))
        self._traced: str | None = None
        # Else the test file that is the first to need a module would get its definitions.
        self._trace(IMPORTING)
        for module, _ in modules(root):
            importlib.import_module(dotted(module))
        self._trace(None)

    def follow(self, path: Path) -> None:
        """Trace from now on, if this is a test file that a module has of its own."""
        self._trace(str(path) if str(path) in self._modules else None)

    def arcs(self) -> Arcs:
        """What the test files reached, each in its own module."""
        self._trace(None)
        data = self._coverage.get_data()
        found: Arcs = {}
        for test, module in self._modules.items():
            data.set_query_contexts([f"^{IMPORTING}$", f"^{re.escape(test)}$"])
            found[module] = data.arcs(module) or []
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
    """The lines and branches that coverage.py reports as missing."""
    lines = [str(line) for line in report["missing_lines"]]
    # A branch out of a line that was not reached says nothing new; a negative one is an exit.
    branches = [
        f"{start}->{end if end > 0 else 'exit'}"
        for start, end in report["missing_branches"]
        if start not in report["missing_lines"]
    ]
    return ", ".join(lines + branches)


class Gathering:
    """What all processes found."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._arcs: dict[str, set[tuple[int, int]]] = {}
        self._lines: list[str] = []

    def add(self, arcs: Arcs) -> None:
        """Add what one process found."""
        for module, found in arcs.items():
            self._arcs.setdefault(module, set()).update((start, end) for start, end in found)

    def shortcomings(self) -> Iterator[str]:
        """Each module that falls short, and where; of those whose test files were asked for."""
        root = self._config.rootpath
        asked = [root / argument.partition("::")[0] for argument in self._config.args]
        looked_at: list[Path] = []
        for module, test in modules(root):
            if not test.exists():
                yield f"{module.relative_to(root)}: there is no {test.relative_to(root)}"
            elif any(map(test.is_relative_to, asked)):
                looked_at.append(module)
        for name, missing in self._uncovered(looked_at).items():
            if missing:
                yield f"{name}: {missing}"

    def _uncovered(self, looked_at: list[Path]) -> dict[str, str]:
        """What was not reached, of each module."""
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
        """Take what a process of pytest-xdist hands over when it ends."""
        self.add(getattr(node, "workeroutput", {}).get("own_coverage", {}))

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if session.exitstatus != pytest.ExitCode.OK:
            self._lines = ["own coverage is not looked at when tests fail"]
        elif short := list(self.shortcomings()):
            self._lines = ["not covered by their own test files:", *short]
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        else:
            self._lines = ["each module is covered by its own test file"]

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for line in self._lines:
            terminalreporter.write_line(line)


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
