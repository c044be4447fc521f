"""The check that modules are covered by their own tests: does it notice one that is not?"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tools import own_coverage, probes, units

SETTINGS = """
[tool.pytest.ini_options]
pythonpath = [".", "transports"]
addopts = ["--import-mode=importlib"]
[tool.coverage.run]
branch = true
source = ["fibaction", "fibaction_transports"]
"""

SIGN = '''"""A module."""

def sign(number):
    if number < 0:
        return -1
    return 1
'''

FIRST = '''"""Another, which uses the one."""

from fibaction.sign import sign

def first_sign(numbers):
    for number in numbers:
        return sign(number)
'''

WHOLE_SIGN = "from fibaction.sign import sign\ndef test_it(): assert sign(-2) + sign(2) == 0\n"
HALF_SIGN = "from fibaction.sign import sign\ndef test_it(): assert sign(2) == 1\n"
WHOLE_FIRST = """
from fibaction.first import first_sign
def test_some(): assert (first_sign([-3]), first_sign([3])) == (-1, 1)
def test_none(): assert first_sign([]) is None
"""
NEGATIVE = "from fibaction.wire.sign import sign\ndef test_it(): assert sign(-2) == -1\n"
POSITIVE = NEGATIVE.replace("-", "")
HALF_FIRST = """
from fibaction.first import first_sign
def test_some(): assert first_sign([-3]) == -1
"""
COVERED = "each module is covered by the tests of its unit, or of whole servers"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Two modules and their test files, laid out as here."""
    for name, text in {
        "pyproject.toml": SETTINGS,
        "fibaction/__init__.py": '"""A package."""\n',
        "fibaction/sign.py": SIGN,
        "fibaction/first.py": FIRST,
        "fibaction/wire/__init__.py": '"""A package."""\n',
        "fibaction/wire/sign.py": SIGN,
        "fibaction/wire/codec.py": SIGN,
        "transports/fibaction_transports/__init__.py": '"""Nothing."""\n',
        "tests/__init__.py": "",
        "tests/tools/__init__.py": "",
        "tests/test_sign.py": WHOLE_SIGN,
        "tests/test_first.py": WHOLE_FIRST,
        "tests/wire/test_minus.py": NEGATIVE,
        "tests/wire/test_plus.py": POSITIVE,
        "tests/contract/test_all.py": WHOLE_SIGN.replace("sign import", "wire.codec import"),
        "tests/transports/tcp/test_tcp.py": "",
    }.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    for module in (own_coverage, probes, units):
        shutil.copy(str(module.__file__), tmp_path / "tests/tools")
    return tmp_path


def run(project: Path, *arguments: str) -> tuple[int, str]:
    """The exit status, and what is said between the dots and the summary."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "-q", "-p", "tests.tools.own_coverage"),
            *("-p", "xdist", "-p", "no:cacheprovider", *arguments),
        ],
        cwd=project,
        # These tests may themselves run in a process of pytest-xdist.
        env={name: value for name, value in os.environ.items() if "PYTEST" not in name}
        | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout + done.stderr


CACHED = {
    "fibaction/sign.py": SIGN.replace("def sign", "from functools import cache\n@cache\ndef sign"),
    "tests/test_first.py": WHOLE_FIRST.replace("3", "2"),
}


@pytest.mark.parametrize("processes", [[], ["-n", "2"]], ids=["here", "workers"])
@pytest.mark.parametrize(
    ("changed", "missing"),
    [
        ({}, ""),
        (CACHED, ""),
        ({"tests/test_sign.py": f"{HALF_SIGN}\nsign(-1)\n"}, ""),
        ({"tests/test_sign.py": HALF_SIGN}, "fibaction/sign.py: 5, 4->5\n"),
        (
            {
                "tests/test_first.py": f"{WHOLE_FIRST}\nfirst_sign([-1])\n",
                "tests/test_sign.py": HALF_SIGN,
            },
            "fibaction/sign.py: 5, 4->5\n",
        ),
        ({"tests/test_sign.py": ""}, "fibaction/sign.py: 4, 5, 6\n"),
        ({"tests/test_first.py": HALF_FIRST}, "fibaction/first.py: 6->exit\n"),
        ({"tests/test_first.py": None}, "fibaction/first.py: there is no tests/test_first.py\n"),
        ({"tests/wire/test_minus.py": None}, "fibaction/wire/sign.py: 5, 4->5\n"),
        ({"tests/contract/test_all.py": ""}, "fibaction/wire/codec.py: 4, 5, 6\n"),
    ],
    ids=[
        "all covered",
        "what another test file has cached is forgotten",
        "its own collection counts",
        "a test file of another module does not count",
        "the collection of another test file does not count",
        "a test file without a test covers nothing",
        "a branch that is never taken",
        "no test file",
        "the tests of a unit count together",
        "the contract counts alone",
    ],
)
def test_a_line_or_branch_that_its_own_tests_do_not_reach_is_named(
    project: Path, processes: list[str], changed: dict[str, str | None], missing: str
) -> None:
    for name, text in changed.items():
        if text is None:
            (project / name).unlink()
        else:
            (project / name).write_text(text)
    status, said = run(project, *processes, "tests")
    assert (missing or COVERED) in said
    for other in ("sign.py", "first.py", "codec.py"):
        assert said.count(f"{other}:") == missing.count(f"{other}:")
    assert status == bool(missing)


def test_a_unit_is_looked_at_when_all_its_tests_are_run(project: Path) -> None:
    (project / "tests/wire/test_minus.py").unlink()
    whole = ["tests/wire", "tests/transports/tcp", "tests/contract"]
    for missing in whole:
        assert COVERED in run(project, *(one for one in whole if one != missing))[1]
    assert COVERED not in run(project, *whole)[1]


def test_only_modules_whose_test_files_are_run_are_looked_at(project: Path) -> None:
    (project / "tests/test_first.py").write_text(HALF_FIRST)
    status, said = run(project, "tests/test_sign.py", "tests/contract")
    assert COVERED in said
    assert status == 0


def test_a_failing_test_is_all_that_is_told(project: Path) -> None:
    (project / "tests/test_sign.py").write_text(f"{HALF_SIGN}\ndef test_no(): assert False\n")
    status, said = run(project, "tests")
    assert "own coverage is not looked at when tests fail" in said
    assert "fibaction/sign.py:" not in said
    assert status == 1
