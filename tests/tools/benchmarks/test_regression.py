"""A regression is told with the commits that may have brought it, and a slow moment is none."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.support.json_program import ROOT
from tests.tools.benchmarks import regression, versions
from tests.tools.benchmarks.regression import (
    Change,
    Ratios,
    change_since,
    compare,
    regressions,
)

needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="git has the commits")


class Scripted:
    """A measurement that returns one ratio for each order, another one each time."""

    def __init__(self, *times: dict[str, float]) -> None:
        self._times = [*times]
        self.asked: list[list[str]] = []

    async def __call__(self, orders: Sequence[str]) -> Ratios:
        self.asked.append([*orders])
        ratios = self._times.pop(0)
        return {order: [ratios[order]] for order in orders}


@pytest.mark.asyncio
async def test_what_is_slow_is_measured_again_alone_and_counts_if_it_is_slow_then() -> None:
    measure = Scripted({"a": 0.7, "b": 0.8, "c": 1.0}, {"a": 0.75, "b": 0.99})

    assert await regressions(measure, ["a", "b", "c"], 0.15) == {"a": 0.75}
    assert measure.asked == [["a", "b", "c"], ["a", "b"]]


def commit(root: Path, subject: str, day: str) -> None:
    who = ["-c", "user.name=someone", "-c", "user.email=someone@example.org"]
    command = ["git", "-C", str(root), *who, "commit", "--quiet", "--allow-empty", "-m", subject]
    subprocess.run(command, check=True, env={"GIT_COMMITTER_DATE": day, "PATH": "/usr/bin:/bin"})


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    subprocess.run(["git", "init", "--quiet", str(tmp_path)], check=True)
    commit(tmp_path, "Begin", "2001-01-01T00:00:00Z")
    return tmp_path


@needs_git
def test_the_range_begins_with_the_newest_commit_that_is_a_day_old(repository: Path) -> None:
    commit(repository, "Hear", "2002-01-01T00:00:00Z")
    commit(repository, "Speak", "2099-01-01T00:00:00Z")
    commit(repository, "Wait", "2099-01-02T00:00:00Z")

    change = change_since("", repository)

    assert change is not None
    assert [each.partition(" ")[2] for each in change.subjects] == ["Wait", "Speak"]
    assert change.head == change.subjects[0].partition(" ")[0]
    assert change_since(change.base, repository) == change


@needs_git
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="an sdist has no commits")
@pytest.mark.asyncio
@pytest.mark.timeout(240)
async def test_a_commit_beside_itself_is_measured_from_a_folder_of_its_own(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(versions, "WORK", {"goals": 2, "batches": 1, "feedback": 10})
    monkeypatch.setattr(versions, "WARM_UP", 0)
    monkeypatch.setattr(regression, "ROUNDS", 1)
    monkeypatch.setattr(regression, "STARTS", 1)

    found = await compare(Change("HEAD", "HEAD", []), most=1.0)

    assert found == {}
    assert capsys.readouterr().out.count("\n") == len(versions.ORDERS)
