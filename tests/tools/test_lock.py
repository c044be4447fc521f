"""The lock of the check: complete, within what the project allows, and used by the workflows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.tools.lock import installed, locked, needed, versions

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = ROOT / ".github" / "workflows"
LIBRARIES = {
    "a": ("1.0", ["b>=2", 'c; extra == "fast"', 'd; python_version < "3"']),
    "b": ("2.1", ["a"]),
    "c": ("3.0", []),
}


def found(*lines: str) -> dict[str, str]:
    return versions(map(Requirement, lines), LIBRARIES.__getitem__)


def test_what_is_required_by_what_is_required_is_locked_too() -> None:
    assert found("a") == {"a": "1.0", "b": "2.1"}


def test_an_extra_is_locked_if_it_is_asked_for_even_later() -> None:
    assert found("a[fast]") == {"a": "1.0", "b": "2.1", "c": "3.0"}
    assert found("a", "A[fast]") == found("a[fast]", "a") == found("a[fast]")


def test_a_library_that_is_not_installed_is_an_error() -> None:
    with pytest.raises(ValueError, match="no_such_library is not installed: make lock"):
        installed("no_such_library")


def test_what_is_locked_is_within_the_bounds_of_the_project() -> None:
    lock = locked()
    wanted = [each for each in needed() if canonicalize_name(each.name) in lock]

    assert len(wanted) > 60
    for requirement in wanted:
        version = lock[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), f"{requirement}: run make lock"


def test_the_lock_is_sorted_and_each_line_of_it_is_read() -> None:
    lines = (ROOT / "tests/tools/lock.txt").read_text(encoding="utf-8").splitlines()
    named = [line.partition("==")[0] for line in lines if not line.startswith("#")]

    assert named == sorted(locked())


def jobs(workflow: str) -> dict[str, Any]:
    text = (WORKFLOWS / workflow).read_text(encoding="utf-8")
    return dict(yaml.safe_load(text)["jobs"])


@pytest.mark.skipif(not WORKFLOWS.exists(), reason="an sdist has no files for GitHub")
@pytest.mark.parametrize(
    ("workflow", "job"),
    [
        ("check.yml", "quick"),
        ("check.yml", "test"),
        ("check.yml", "docs"),
        ("publish.yml", "build"),
    ],
)
def test_the_check_of_a_change_installs_with_pip_and_with_uv_what_is_locked(
    workflow: str, job: str
) -> None:
    path = "${{ github.workspace }}/tests/tools/lock.txt"

    assert jobs(workflow)[job]["env"] == {"PIP_CONSTRAINT": path, "UV_CONSTRAINT": path}


@pytest.mark.skipif(not WORKFLOWS.exists(), reason="an sdist has no files for GitHub")
def test_each_night_the_newest_are_tried_and_the_locked_ones_are_audited() -> None:
    nightly = jobs("nightly.yml")

    assert "env" not in nightly["newest"]
    assert nightly["newest"]["steps"][-1] == {"run": "make lint types imports unit programs"}
    assert nightly["audit"]["steps"][-1] == {"run": "make audit"}
