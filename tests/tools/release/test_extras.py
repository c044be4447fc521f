"""Each extra is tried by a release. All libraries are installed here, so only the checks are."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import fibaction
from tests.tools.release import extras

ROOT = Path(__file__).resolve().parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def tried(extra: str, version: str) -> subprocess.CompletedProcess[str]:
    """Run the program as a release does."""
    command = [sys.executable, "-P", extras.__file__, extra, version]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_there_is_a_check_for_each_extra() -> None:
    assert list(extras.CHECKS) == sorted(PROJECT["optional-dependencies"])


@pytest.mark.timeout(180)
def test_the_checks_pass_where_all_extras_are() -> None:
    done = tried("all", fibaction.__version__)

    assert (done.stdout, done.stderr) == (f"all: works with {fibaction.__version__}\n", "")


def test_another_version_than_the_wheels_is_an_error() -> None:
    done = tried("none", "0.0.9")

    assert done.returncode == 1
    assert f"AssertionError: {fibaction.__version__}" in done.stderr


def test_a_release_tries_each_extra() -> None:
    program = (ROOT / "tests/tools/release/make.sh").read_text(encoding="utf-8")
    (found,) = re.findall(r"^extras=\$\((.*)\)$", program, re.MULTILINE)
    told = subprocess.run(["sh", "-c", found], cwd=ROOT, capture_output=True, text=True, check=True)
    assert sorted(told.stdout.split()) == sorted(PROJECT["optional-dependencies"])
