"""The second try of failed tests that start processes: which have one, and what is green."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SECOND_TRY = Path(__file__).with_name("second_try.py")

CONFTEST = """
import os, subprocess, sys
from pathlib import Path
import pytest
import second_try

def pytest_configure(config):
    second_try.register(config)

def run(program="pass"):
    subprocess.run([sys.executable, "-S", "-c", program], check=True)

def fails_once(name):
    try:
        Path(__file__).with_name(f"{name}.begun").touch(exist_ok=False)
    except FileExistsError:
        return
    print(f"{name} prints this")
    raise AssertionError(f"{name} fails")

@pytest.fixture(scope="session")
def broker():
    run()

pytest.run, pytest.fails_once = run, fails_once
"""

FLAKY = "def test_flaky{0}(): pytest.run(); pytest.fails_once('flaky{0}')\n"
GOOD = "def test_good(): pytest.run()\n"
WITH_BROKER = "def test_first(broker): pass\ndef test_flaky(broker): pytest.fails_once('flaky')\n"
MARKED = "@pytest.mark.processes\ndef test_flaky(): pytest.fails_once('flaky')\n"
HANGS_ONCE = """
@pytest.mark.timeout(1)
def test_flaky():
    seconds = 0 if os.path.exists("begun") else 60
    open("begun", "w").close()
    pytest.run(f"import time; time.sleep({seconds})")
"""
CRASHES_ONCE = """
def test_flaky():
    pytest.run()
    try: pytest.fails_once("flaky")
    except AssertionError: os._exit(1)
"""


@pytest.fixture
def tries(tmp_path: Path) -> Path:
    """The folder of the second tries, in a project where the plugin is used."""
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = processes\npythonpath = .\n")
    (tmp_path / "second_try.py").write_text(SECOND_TRY.read_text())
    (tmp_path / "conftest.py").write_text(CONFTEST)
    folder = tmp_path / "tries"
    folder.mkdir()
    return folder


def run(tries: Path, *arguments: str) -> tuple[int, str]:
    """Return the exit status, and what is printed."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", *arguments],
        cwd=tries.parent,
        env={**kept, "FIBACTION_SECOND_TRIES": str(tries), "FIBACTION_ROS": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    return done.returncode, done.stdout


def begin(tries: Path, tests: str, *arguments: str) -> tuple[int, str]:
    """Run these tests, and return the exit status, and what is printed."""
    (tries.parent / "test_it.py").write_text(f"import os, pytest\n{tests}")
    return run(tries, "pytest", "-p", "no:cacheprovider", "test_it.py", *arguments)


@pytest.mark.parametrize(
    ("failing", "arguments"),
    [
        (FLAKY.format(""), []),
        (FLAKY.format(""), ["-n", "1"]),
        (WITH_BROKER, []),
        (MARKED, []),
        (HANGS_ONCE, []),
        (CRASHES_ONCE, ["-n", "1"]),
    ],
    ids=["process", "worker", "fixture", "mark", "timeout", "crash"],
)
def test_a_test_that_fails_only_once_is_green_and_named_at_the_end(
    tries: Path, failing: str, arguments: list[str]
) -> None:
    status, said = begin(tries, GOOD + failing, *arguments)
    assert status == 0, said
    assert "1 failed" in said.splitlines()[-2]
    assert said.splitlines()[-1].startswith("each failed test is run once more, alone")
    status, said = run(tries, "second_try", str(tries))
    assert status == 0, said
    assert "1 passed" in said
    assert "---- the first failure of test_it.py::test_flaky" in said
    assert said.splitlines()[-1] == "flaky: test_it.py::test_flaky"


def test_a_test_that_fails_twice_is_red(tries: Path) -> None:
    assert begin(tries, "def test_always(): pytest.run(); assert False\n")[0] == 0
    status, said = run(tries, "second_try", str(tries))
    assert status == 1
    assert said.splitlines()[-1] == "failed twice: test_it.py::test_always"


@pytest.mark.parametrize(
    "failing",
    [
        "def test_plain(): pytest.fails_once('plain')\n",
        "def test_plain(): pytest.fails_once('plain')\n" + FLAKY.format(""),
        "".join(map(FLAKY.format, "123")),
        FLAKY.format("") + "import missing\n",
    ],
    ids=["plain", "one of each", "three", "collection"],
)
@pytest.mark.parametrize("arguments", [[], ["-n", "1"]], ids=["here", "worker"])
def test_other_failures_and_more_than_two_are_red_at_once(
    tries: Path, failing: str, arguments: list[str]
) -> None:
    assert begin(tries, failing, *arguments)[0] != 0
    assert not list(tries.glob("*.json"))


def test_three_flaky_tests_of_several_runs_are_red(tries: Path) -> None:
    assert begin(tries, "".join(map(FLAKY.format, "12")))[0] == 0
    assert begin(tries, FLAKY.format("3"))[0] == 1
