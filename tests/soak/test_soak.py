"""The soak: what it says of itself, what it records, and which growth it finds."""

from __future__ import annotations

import copy
import json
from typing import Any
from xml.etree import ElementTree

import anyio
import pytest

from tests.soak import peers
from tests.soak.trial import COUNTED, SAMPLES, USED, Soak, faults, run
from tests.support.ros_domain import own_domain
from tests.tools import figures

REPORTS = figures.read()
every_soak = pytest.mark.parametrize("name", figures.SOAKS)


@pytest.mark.asyncio
async def test_a_soak_beside_load_records_both_processes_over_the_time() -> None:
    report = await run(Soak(seconds=0.5, load=1), count=20)

    assert report["goals"] > 0
    assert len(report["at"]) == 20
    for end in ("server", "client"):
        assert all(len(report[end][what]) == 20 for what in USED)
        assert max(report[end]["files"]) >= report["connections"]
        before, after = report["before"][end], report["after"][end]
        assert {what: after[what] for what in COUNTED if after[what] > before[what]} == {}
    assert 0 <= report["others_share"] <= 1
    assert json.loads(json.dumps(report)) == report


@pytest.mark.asyncio
async def test_a_soak_over_dds_runs_goals_without_more_to_be_set() -> None:
    report = await run(Soak(seconds=3, over="dds"), count=20)

    assert report["goals"] > 0
    assert report["connections"] == 4


def test_the_command_of_a_report_is_the_one_that_was_given() -> None:
    assert Soak(600).command == "python -m tests.soak --keep"
    asked = "python -m tests.soak --seconds 60 --over ws --load 2 --keep"
    assert Soak(60, "ws", 2).command == asked


def broken(**changed: Any) -> list[str]:
    """Return the faults of the kept report with changes in the server's part."""
    report = copy.deepcopy(REPORTS["soak"])
    report["server"] |= changed.pop("server", {})
    report["after"]["server"] |= changed.pop("after", {})
    return faults(report | changed)


def test_growth_and_remains_are_faults() -> None:
    assert broken() == []
    growing = [50_000_000 + 100_000 * number for number in range(SAMPLES)]
    (grown,) = broken(server={"memory": growing})
    assert grown.startswith("the memory of the server has grown from ")
    assert broken(after={"tasks": 2}) == ["the server has 2 tasks at the end, and had 1 before"]
    assert broken(ends={}) == ["no goal has ended"]


# What docs/shown_to_hold.md shows of it


@every_soak
def test_the_picture_is_made_of_the_report_and_shows_all_that_was_recorded(name: str) -> None:
    kept = (figures.FOLDER / f"{name}.svg").read_text(encoding="utf-8")
    assert kept == figures.picture(REPORTS[name])
    root = ElementTree.fromstring(kept)
    paths = [one for one in root.iter("{http://www.w3.org/2000/svg}path") if one.get("stroke")]
    assert len(paths) == len(USED) * 2
    assert all((one.get("d") or "").count(",") == SAMPLES for one in paths)


@every_soak
def test_the_kept_report_is_of_ten_minutes_and_found_no_growth(name: str) -> None:
    assert REPORTS[name]["seconds"] == 600
    assert faults(REPORTS[name]) == []


def test_the_page_is_made_of_the_reports() -> None:
    page = figures.PAGE.read_text(encoding="utf-8")
    assert figures.with_parts(page, REPORTS) == page


# Subscriptions whose publishers are killed


@pytest.mark.timeout(240)  # it starts eight processes
def test_a_hundred_subscriptions_outlive_their_publishers() -> None:
    with own_domain():
        report = anyio.run(peers.run, 0.1, 2)

    assert report["kills"] == 8
    assert report["messages"] >= 2 * peers.TOPICS
    assert peers.faults(report["samples"]) == []


def test_what_grows_while_publishers_are_killed_is_a_fault() -> None:
    samples = [{"memory": 10**6, "tasks": 9, "files": 9, "threads": 9} for _ in range(20)]
    assert peers.faults(samples) == []
    samples[-1] |= {"memory": 10**7, "tasks": 10}
    samples[-2]["memory"] = 10**7
    assert peers.faults(samples) == [
        "the memory has grown from 1,000,000 to 10,000,000 bytes",
        "there were 10 tasks, and 9 after the first round",
    ]
