"""A second try, alone, for a failed test that starts processes, or uses a broker, a browser or ROS.

`.ci/run` names a folder in FIBACTION_SECOND_TRIES. Each run of pytest below it then writes its
failures of this kind there, and passes if it has no others. At the end, `.ci/run` calls

    python -m tests.tools.second_try FOLDER

which runs each of these tests once more, alone. If all pass, and they are at most two, the check is
green, and the last lines name them as flaky, with the output of the first failure.

A test is of this kind if it, or a fixture that it uses, starts a process, if it is marked
`processes`, or if it runs where ROS is required. A test that runs out of time, or whose process
crashes, has failed like any other.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import uuid
from collections.abc import Callable, Generator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

import pytest

FOLDER = os.environ.get("FIBACTION_SECOND_TRIES")
"""Where the failures are written; the plugin is off without it."""

MOST = 2
"""The most flaky tests of a check that is green."""

PATIENCE = 600.0
"""Seconds for the second try of one test."""

KIND = "starts_processes"
"""The attribute of a report on a test of this kind, which pytest-xdist hands over."""


class Failure(NamedTuple):
    """A failed test, and how to run it again."""

    test: str
    command: list[str]
    folder: str
    environment: dict[str, str]
    output: str

    def write(self, folder: Path) -> None:
        """Write it into a file of its own."""
        folder.joinpath(f"{uuid.uuid4()}.json").write_text(json.dumps(self._asdict()))

    def passes(self) -> bool:
        """Run the test once more, and return whether it passes."""
        try:
            return not subprocess.run(
                self.command, cwd=self.folder, env=self.environment, timeout=PATIENCE
            ).returncode
        except subprocess.TimeoutExpired:
            return False


def failures(folder: Path) -> list[Failure]:
    """Read the failures of all runs so far."""
    return [Failure(**json.loads(path.read_text())) for path in sorted(folder.glob("*.json"))]


class Marking:
    """Marks the reports on tests that start processes; it runs where the tests run."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started = 0
        self._of_test = 0
        """The number of processes that had been started before the test."""
        self._fixtures: set[tuple[str, str]] = set()
        """The fixtures that have started processes for more than one test: where, and the name."""
        self._is_told = False
        self._test = ""
        subprocess.Popen.__init__ = self._counted(subprocess.Popen.__init__)  # type: ignore[method-assign]  # the only place that all ways to start a program pass
        BaseProcess.start = self._counted(BaseProcess.start)  # type: ignore[method-assign]  # as above

    def _counted(self, start: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            self._started += 1
            self._tell_once()
            return start(*args, **kwargs)

        return counted

    def _tell_once(self) -> None:
        """Write the test down, since a process that crashes makes no report."""
        if not self._is_told:
            self._is_told = True
            with self._folder.joinpath(f"{os.getpid()}.tests").open("a") as file:
                file.write(f"{self._test}\n")

    def _is_of_this_kind(self, item: pytest.Item) -> bool:
        names = getattr(item, "fixturenames", ())
        return (
            self._started > self._of_test
            or item.get_closest_marker("processes") is not None
            or os.environ.get("FIBACTION_ROS") == "required"
            or any(name in names and item.nodeid.startswith(at) for at, name in self._fixtures)
        )

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(
        self, fixturedef: pytest.FixtureDef[Any]
    ) -> Generator[None, object, object]:
        before = self._started
        try:
            return (yield)
        finally:
            if self._started > before and fixturedef.scope != "function":
                self._fixtures.add((fixturedef.baseid, fixturedef.argname))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._test, self._is_told, self._of_test = nodeid, False, self._started

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Generator[None, object, object]:
        try:
            return (yield)
        finally:
            if self._is_of_this_kind(item):
                self._tell_once()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        setattr(report, KIND, self._is_of_this_kind(item))
        return report


class Deferral:
    """Puts the failures of this kind off to the end of the check; it runs where all ends."""

    def __init__(self, config: pytest.Config, folder: Path) -> None:
        self._config = config
        self._folder = folder
        self._outputs: dict[str, str] = {}
        self._is_other = False
        self._line = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if not report.failed:
            return
        is_crash = not hasattr(report, KIND)
        if report.nodeid in self._crashed() if is_crash else getattr(report, KIND):
            output = [
                report.longreprtext,
                *(f"---- {name}\n{text}" for name, text in report.sections),
            ]
            self._outputs.setdefault(report.nodeid, "\n".join(output))
        else:
            self._is_other = True

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        self._is_other |= report.failed

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if session.exitstatus != pytest.ExitCode.TESTS_FAILED or self._is_other:
            return
        if self._outputs and len(failures(self._folder)) + len(self._outputs) <= MOST:
            for test, output in self._outputs.items():
                self._failure(test, output).write(self._folder)
            self._line = "each failed test is run once more, alone, at the end of the check"
            session.exitstatus = pytest.ExitCode.OK

    @pytest.hookimpl(tryfirst=True)
    def pytest_unconfigure(self, config: pytest.Config) -> None:
        reporter = config.pluginmanager.get_plugin("terminalreporter")
        if reporter is not None and self._line:
            reporter.write_line(self._line)

    def _crashed(self) -> set[str]:
        """Return the tests of this kind that have begun."""
        return {
            line for path in self._folder.glob("*.tests") for line in path.read_text().splitlines()
        }

    def _failure(self, test: str, output: str) -> Failure:
        asked = self._config.option.file_or_dir
        options = [each for each in self._config.invocation_params.args if each not in asked]
        return Failure(
            test,
            [
                *(sys.executable, "-m", "pytest", *map(str, options), "-n", "0"),
                *("-p", "no:tests.tools.own_coverage", str(self._config.rootpath / test)),
            ],
            str(self._config.invocation_params.dir),
            {
                name: value
                for name, value in os.environ.items()
                if name != "FIBACTION_SECOND_TRIES"
                and not name.startswith(("PYTEST_", "COVERAGE_"))
            },
            output,
        )


def register(config: pytest.Config) -> None:
    """Begin, if a folder is named, and no test has started this pytest."""
    if FOLDER is None or "PYTEST_CURRENT_TEST" in os.environ:
        return
    if "PYTEST_XDIST_WORKER" in os.environ or not config.getoption("numprocesses", None):
        config.pluginmanager.register(Marking(Path(FOLDER)))
    if "PYTEST_XDIST_WORKER" not in os.environ:
        config.pluginmanager.register(Deferral(config, Path(FOLDER)))


def main() -> int:
    """Run the failed tests once more, and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.second_try",
        description="Run the failed tests of a check once more, each alone.",
    )
    parser.add_argument("folder", type=Path)
    failed = failures(parser.parse_args().folder)
    passed = []
    for each in failed:
        print(f"---- once more, alone: {each.test}", flush=True)
        passed.append(each.passes())
    for each in failed:
        print(f"---- the first failure of {each.test}\n{each.output}")
    for each, has_passed in zip(failed, passed, strict=True):
        print("flaky:" if has_passed else "failed twice:", each.test)
    if len(failed) > MOST:
        print(f"{len(failed)} tests failed at first, and at most {MOST} may")
    return 0 if all(passed) and len(failed) <= MOST else 1


if __name__ == "__main__":
    sys.exit(main())
