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


@pytest.mark.parametrize("processes", [[], ["-n", "2"]])
def test_modules_that_are_covered_pass(project: Path, processes: list[str]) -> None:
    status, said = run(project, *processes, "tests")
    assert COVERED in said
    assert status == 0


def test_what_another_modules_test_file_reaches_does_not_count(project: Path) -> None:
    (project / "tests/test_sign.py").write_text(HALF_SIGN)
    status, said = run(project, "tests")
    assert "fibaction/sign.py: 5, 4->5\n" in said
    assert "first.py" not in said
    assert status == 1


def test_a_branch_that_is_never_taken_is_missing(project: Path) -> None:
    (project / "tests/test_first.py").write_text(HALF_FIRST)
    status, said = run(project, "tests")
    assert "fibaction/first.py: 6->exit\n" in said
    assert status == 1


def test_what_runs_while_another_test_file_is_collected_does_not_count(project: Path) -> None:
    (project / "tests/test_first.py").write_text(f"{WHOLE_FIRST}\nfirst_sign([-1])\n")
    (project / "tests/test_sign.py").write_text(HALF_SIGN)
    status, said = run(project, "tests")
    assert "fibaction/sign.py: 5, 4->5\n" in said
    assert status == 1


def test_what_another_test_file_has_cached_is_forgotten(project: Path) -> None:
    cached = SIGN.replace("def sign", "from functools import cache\n@cache\ndef sign")
    (project / "fibaction/sign.py").write_text(cached)
    (project / "tests/test_first.py").write_text(WHOLE_FIRST.replace("3", "2"))
    status, said = run(project, "tests")
    assert COVERED in said
    assert status == 0


def test_what_a_test_file_reaches_while_it_is_collected_counts(project: Path) -> None:
    (project / "tests/test_sign.py").write_text(f"{HALF_SIGN}\nsign(-1)\n")
    status, said = run(project, "tests")
    assert COVERED in said
    assert status == 0


def test_a_module_without_a_test_file_is_named(project: Path) -> None:
    (project / "tests/test_first.py").unlink()
    status, said = run(project, "tests")
    assert "fibaction/first.py: there is no tests/test_first.py\n" in said
    assert status == 1


def test_a_test_file_without_a_test_covers_nothing(project: Path) -> None:
    (project / "tests/test_sign.py").write_text("")
    status, said = run(project, "tests")
    assert "fibaction/sign.py: 4, 5, 6\n" in said
    assert status == 1


@pytest.mark.parametrize("processes", [[], ["-n", "2"]])
def test_the_tests_of_a_unit_cover_its_modules_together(
    project: Path, processes: list[str]
) -> None:
    (project / "tests/wire/test_minus.py").unlink()
    status, said = run(project, *processes, "tests")
    assert "fibaction/wire/sign.py: 5, 4->5\n" in said
    assert status == 1


def test_a_unit_is_looked_at_when_all_its_tests_are_run(project: Path) -> None:
    (project / "tests/wire/test_minus.py").unlink()
    whole = ["tests/wire", "tests/transports/tcp", "tests/contract"]
    for missing in whole:
        assert COVERED in run(project, *(one for one in whole if one != missing))[1]
    assert COVERED not in run(project, *whole)[1]


def test_a_module_that_the_contract_alone_covers_passes(project: Path) -> None:
    (project / "tests/contract/test_all.py").write_text("")
    status, said = run(project, "tests")
    assert "fibaction/wire/codec.py: 4, 5, 6\n" in said
    assert status == 1


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
