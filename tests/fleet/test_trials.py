"""The faults of a fleet, for a short time each, with processes of nats-server."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import anyio
import pytest

from tests.fleet import scenarios
from tests.fleet.clients import Load
from tests.fleet.scenarios import Report, Run, run
from tests.support.nats_server import needs_nats

both = pytest.mark.parametrize("recovery", ["abort", "rerun"])
# Processes are started one after the other on a machine that may be busy, and calls of clients have
# a time of their own.
patient = pytest.mark.timeout(240)
LEASE = 5.0
"""Seconds: the default with one broker. With 2 s, a broker on a busy machine answers too late, and
a worker is lost to which no harm was done."""


def trial(
    name: str,
    folder: Path,
    recovery: Literal["abort", "rerun"],
    load: Load,
    lease: float | None,
    limit: int = 0,
) -> Report:
    report = anyio.run(run, name, Run(recovery, load, lease, limit=limit), folder)

    assert report.faults == []
    assert report.goals == report.answered == load.goals
    return report


@pytest.mark.promise("FLEET-1", "FLEET-2", "FLEET-4", "FLEET-5")
@needs_nats
@patient
@both
def test_goals_of_lost_workers_end_once_and_in_time(
    tmp_path: Path, recovery: Literal["abort", "rerun"]
) -> None:
    load = Load(60, steps=(10, 18), pause=0.3, spread=1.0)

    report = trial("workers", tmp_path, recovery, load, lease=LEASE)

    assert report.handovers["w1"].goals > 0
    assert report.handovers["w2"].goals > 0
    assert report.moves > 0
    assert report.rejoined == ["w2"]
    assert report.unseen_writes == 0


@pytest.mark.promise("FLEET-3")
@needs_nats
@patient
def test_a_broker_that_was_away_for_less_than_a_lease_takes_no_goal_from_its_worker(
    tmp_path: Path,
) -> None:
    load = Load(60, steps=(4, 12), pause=0.3, spread=1.5)

    # With the default of 5 s, a broker that takes two seconds to start is away for a lease.
    report = trial("broker", tmp_path, "rerun", load, lease=10.0)

    assert report.moves == 0
    assert report.rejoined == []


@pytest.mark.promise("FLEET-3")
@needs_nats
@patient
def test_the_loss_of_one_broker_of_three_loses_nothing(tmp_path: Path) -> None:
    load = Load(60, steps=(2, 8), pause=0.3, late=0.6, spread=4.0)

    # With the default of 15 s, two elections that find no leader take a lease.
    report = trial("leader", tmp_path, "rerun", load, lease=40.0)

    assert report.moves == 0
    assert report.rejoined == []


@pytest.mark.promise("FLEET-5", "FLEET-6")
@needs_nats
@patient
@both
def test_a_worker_that_stops_hands_its_goals_over(
    tmp_path: Path, recovery: Literal["abort", "rerun"]
) -> None:
    load = Load(60, steps=(10, 18), pause=0.3, spread=1.0)

    report = trial("drain", tmp_path, recovery, load, lease=LEASE)

    assert report.handovers["w1"].goals > 0
    assert report.moves > 0


@pytest.mark.promise("FLEET-15")
@needs_nats
@patient
def test_no_cancel_is_answered_unknown_while_workers_are_killed_stop_and_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenarios, "ROUNDS", 1)
    load = Load(60, steps=(4, 30), pause=0.3, spread=3.0, canceled=1.0)

    report = trial("chaos", tmp_path, "rerun", load, lease=LEASE)

    assert report.ends["CANCELED"] > 0
    assert report.moves > 0


@pytest.mark.promise("FLEET-12")
@needs_nats
@patient
def test_a_limit_for_keys_holds_when_workers_are_killed_and_frozen(tmp_path: Path) -> None:
    load = Load(60, steps=(1, 3), pause=0.3, spread=1.0, keys=3)

    report = trial("workers", tmp_path, "rerun", load, lease=LEASE, limit=1)

    assert report.key_pauses["w1"]
    assert report.rejoined == ["w2"]


@pytest.mark.promise("FLEET-12")
@needs_nats
@patient
def test_with_three_brokers_a_killed_worker_gives_its_places_back_in_time(tmp_path: Path) -> None:
    load = Load(60, steps=(1, 3), pause=0.3, late=0.4, spread=1.0, keys=3)

    report = trial("places", tmp_path, "rerun", load, lease=12.0, limit=1)

    assert report.key_pauses["w1"]
    assert report.rejoined == []
