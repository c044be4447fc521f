"""A few seconds of simulation, and tests of the simulator itself."""

from __future__ import annotations

import logging
import os
import random
import secrets
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import CancelAnswer, CancelCode, GoalID, GoalInfo, GoalStatus, Outcome
from fibaction.protocol import ServerProtocol
from tests.simulation import __main__ as command
from tests.simulation import loop as virtual
from tests.simulation.invariants import Life, Record, Violation
from tests.simulation.making import scenario_of
from tests.simulation.network import Line, Network
from tests.simulation.scenario import (
    DEEDS,
    KINDS,
    ClientPlan,
    Deed,
    Done,
    Scenario,
    ServerPlan,
    Step,
    Work,
)
from tests.simulation.streams import SimulatedStream, Weather
from tests.simulation.views import View, Watch
from tests.simulation.world import Report, simulate

FIXED = range(80)
"""Seeds that are run each time."""
FRESH = 40
"""How many seeds are run that nobody has seen before."""
ROOT = Path(__file__).parents[2]


def check(report: Report) -> None:
    """Fail, and tell everything, if the run has."""
    if report.violations:
        command.tell_failure(report)
        pytest.fail(f"seed {report.scenario.seed}: {report.violations[0]}")


# The product


def test_the_same_seeds_find_nothing_each_time() -> None:
    for seed in FIXED:
        check(simulate(scenario_of(seed)))


def test_fresh_seeds_find_nothing() -> None:
    first = secrets.randbelow(command.SEEDS)
    for seed in range(first, first + FRESH):
        check(simulate(scenario_of(seed)))


def test_a_goal_that_nobody_reads_ends_for_a_client_with_a_window_of_one() -> None:
    # It waited for ever: of one message none was let go of, and the end came behind the next.
    deeds = (Deed(0.0, "unread", Work(1, "busy", steps=5)), Deed(1.0, "get result", Work(2)))
    client = ClientPlan("client-0", Weather(), window=1, deeds=deeds)
    check(simulate(Scenario(0, "calm", ServerPlan(), (client,))))


# The same again


def test_a_seed_is_the_same_run_each_time() -> None:
    for seed in range(5):
        assert simulate(scenario_of(seed)).trace == simulate(scenario_of(seed)).trace


def test_a_seed_is_the_same_run_in_every_process() -> None:
    program = (
        "from tests.simulation.world import simulate\n"
        "from tests.simulation.making import scenario_of\n"
        "print(*(simulate(scenario_of(seed)).digest for seed in range(20, 60)))"
    )

    def digests(hash_seed: str) -> str:
        return subprocess.run(
            [sys.executable, "-c", program],
            cwd=ROOT,
            env={
                **os.environ,
                "PYTHONPATH": f"{ROOT}:{ROOT / 'transports'}",
                "PYTHONHASHSEED": hash_seed,
            },
            check=True,
            capture_output=True,
            text=True,
        ).stdout

    assert digests("1") == digests("4242")


def test_scenarios_are_of_all_kinds() -> None:
    scenarios = [scenario_of(seed) for seed in range(1000)]
    deeds = [deed for one in scenarios for client in one.clients for deed in client.deeds]
    faults = {fault.kind for one in scenarios for fault in one.faults}
    assert {one.climate for one in scenarios} == {"calm", "gentle", "rough"}
    assert {deed.kind for deed in deeds} == {kind for kind, _ in DEEDS}
    assert {deed.work.kind for deed in deeds} == set(KINDS)
    assert len(faults) == 8
    assert all(not one.faults for one in scenarios if one.climate == "calm")
    assert not any(one.has_restarts for one in scenarios if one.climate == "gentle")


# The command


def test_the_command_replays_a_seed(capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setattr(sys, "argv", ["simulation", "--seed", "3", "--trace"])
    assert command.main() == 0
    printed = capsys.readouterr().out
    assert "server 1 starts" in printed
    assert simulate(scenario_of(3)).digest in printed


def test_the_command_counts_what_it_has_run(
    capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.setattr(sys, "argv", ["simulation", "--seconds", "0.3", "--from", "0"])
    assert command.main() == 0
    printed = capsys.readouterr().out
    assert "first seed: 0" in printed
    assert '"scenarios": ' in printed


def test_the_command_tells_how_to_see_a_failure_again(
    capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    def failing(scenario: Any) -> Report:
        wrong = Violation("once", "it ran twice", 1.0)
        return Report(scenario, [wrong], ["a", "b"], 0, 0, 0, 0, 1.0)

    monkeypatch.setattr(command, "simulate", failing)
    monkeypatch.setattr(sys, "argv", ["simulation", "--seconds", "5", "--from", "77"])
    assert command.main() == 1
    printed = capsys.readouterr().out
    assert "it ran twice" in printed
    assert "python -m tests.simulation --seed 77 --trace" in printed


# The loop


def in_virtual_time(main: Callable[[], Awaitable[Any]], **settings: Any) -> virtual.VirtualLoop:
    loop = virtual.VirtualLoop(**settings)
    virtual.run(main, loop)
    return loop


def test_an_hour_passes_at_once() -> None:
    async def main() -> None:
        begun = anyio.current_time()
        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(anyio.sleep, 3600)
        assert 3600 <= anyio.current_time() - begun < 3601

    assert in_virtual_time(main).turns < 100


def test_a_timeout_comes_when_it_is_due() -> None:
    async def main() -> None:
        with anyio.move_on_after(5) as scope:
            await anyio.sleep_forever()
        assert scope.cancelled_caught

    loop = in_virtual_time(main)
    assert 5 <= loop.now - virtual.EPOCH < 5.01


def test_if_nobody_can_ever_run_the_loop_says_who_waits() -> None:
    async def waits_in_vain() -> None:
        await anyio.Event().wait()

    with pytest.raises(virtual.Deadlock, match="waits_in_vain"):
        in_virtual_time(waits_in_vain)


def test_a_loop_that_only_turns_is_stopped() -> None:
    async def turns() -> None:
        while True:
            await anyio.lowlevel.checkpoint()

    with pytest.raises(virtual.Livelock):
        in_virtual_time(turns, most_turns=1000)


def test_a_loop_that_only_sleeps_is_stopped() -> None:
    async def sleeps() -> None:
        for _ in range(3600):
            await anyio.sleep(60)

    with pytest.raises(virtual.Livelock):
        in_virtual_time(sleeps, longest=3600)


# The network


def over_a_line(
    main: Callable[[Network, Line, SimulatedStream, SimulatedStream], Awaitable[None]],
    weather: Weather | None = None,
) -> None:
    """Run a test between the two ends of a connection."""
    loop = virtual.VirtualLoop()

    async def connected() -> None:
        network = Network(loop, random.Random(1), lambda _: None)
        line = network.line("client", weather or Weather())
        listening = network.host.listen()
        near = await line.dial()
        far = await listening.accept()
        with anyio.fail_after(1000):
            await main(network, line, near, far)
        await near.aclose()
        await far.aclose()
        assert network.open_ends() == []

    virtual.run(connected, loop)


async def all_of(stream: SimulatedStream, count: int) -> bytes:
    received = b""
    while len(received) < count:
        received += await stream.receive()
    return received


def test_bytes_arrive_in_order_after_a_while() -> None:
    sent = bytes(range(256)) * 10

    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        begun = anyio.current_time()
        for start in range(0, len(sent), 100):
            await near.send(sent[start : start + 100])
        assert await all_of(far, len(sent)) == sent
        assert anyio.current_time() - begun >= 0.5

    over_a_line(main, Weather(latency=0.5, jitter=0.2, pieces=7))


def test_a_sender_waits_for_a_reader() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        await near.send(bytes(1000))
        with anyio.move_on_after(60) as scope:
            await near.send(b"more")
        assert scope.cancelled_caught
        await all_of(far, 1000)
        await near.send(b"more")
        assert await far.receive() == b"more"

    over_a_line(main, Weather(buffer=1000))


def test_a_connection_that_is_cut_loses_what_is_under_way() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        await near.send(bytes(1000))
        line.cut("reset")
        received = b""
        with pytest.raises(anyio.BrokenResourceError):
            while True:
                received += await far.receive()
        assert len(received) < 1000
        with pytest.raises(anyio.BrokenResourceError):
            await near.receive()
        with pytest.raises(anyio.BrokenResourceError):
            await near.send(b"x")

    over_a_line(main, Weather(latency=0.001, pieces=9))


def test_a_silent_end_tells_nobody() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        line.cut("silence")
        await near.send(b"lost")
        with anyio.move_on_after(500) as scope:
            await far.receive()
        assert scope.cancelled_caught

    over_a_line(main)


def test_half_of_a_connection_can_end() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        line.half_close("up")
        with pytest.raises(anyio.EndOfStream):
            await far.receive()
        await far.send(b"still here")
        assert await near.receive() == b"still here"

    over_a_line(main)


def test_a_frozen_line_goes_on_later() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        begun = anyio.current_time()
        line.freeze(30, "up")
        await near.send(b"late")
        assert await far.receive() == b"late"
        assert anyio.current_time() - begun >= 30

    over_a_line(main)


def test_a_new_connection_may_overtake_an_old_one() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        line.freeze(30, "up", "down", new_too=False)
        await near.send(b"old")
        assert network.host.listener is not None
        second = await line.dial()
        accepted = await network.host.listener.accept()
        await second.send(b"new")
        assert await accepted.receive() == b"new"
        assert await far.receive() == b"old"
        await second.aclose()
        await accepted.aclose()

    over_a_line(main)


def test_who_closes_is_seen_to_have_closed() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        await near.send(b"last")
        await near.aclose()
        assert await far.receive() == b"last"
        with pytest.raises(anyio.EndOfStream):
            await far.receive()
        await far.send(b"to nobody")
        with pytest.raises(anyio.BrokenResourceError):
            await far.send(b"to nobody")
        with pytest.raises(anyio.ClosedResourceError):
            await near.receive()

    over_a_line(main)


def test_a_line_may_refuse() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        line.refuses_until = anyio.current_time() + 1
        with pytest.raises(ConnectionRefusedError):
            await line.dial()

    over_a_line(main)


def test_a_host_that_dies_breaks_its_ends_at_once_and_listens_no_more() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        network.host.die("silence")
        with pytest.raises(anyio.BrokenResourceError):
            await far.receive()
        with pytest.raises(ConnectionRefusedError):
            await line.dial()

    over_a_line(main)


# The invariants

GOAL = GoalID(b"a goal of a test")


class Known:
    """A record that knows one goal, of one server, sent by one client."""

    def __init__(self, seed: int = 0) -> None:
        self.now = 10.0
        self.record = Record(scenario_of(seed), lambda: self.now)
        self.protocol = ServerProtocol()
        self.life = Life(1, 0.0, self.protocol)
        self.record.lives.append(self.life)
        self.client = self.record.clients["client-0"]
        self.client.goals.add(GOAL)
        self.record.accepted(self.life, GOAL, 1)
        self.truth = self.record.started(GOAL, 1)
        self.view = View(self.record, self.client, GOAL, 1, start=0)

    def found(self) -> list[str]:
        """The invariants that do not hold."""
        return [violation.invariant for violation in self.record.violations]

    def ends(self, *statuses: GoalStatus) -> None:
        for status in statuses:
            self.record.changed(self.truth, status)
        self.record.ended(self.truth, Outcome(statuses[-1]), self.truth.count)


def test_a_goal_that_is_started_twice_is_found() -> None:
    known = Known()
    known.record.started(GOAL, 1)
    assert known.found() == ["once"]


def test_a_goal_that_is_accepted_twice_is_found() -> None:
    known = Known()
    known.record.accepted(known.life, GOAL, 2)
    assert known.found() == ["once"]


def test_a_goal_that_ends_twice_or_never_is_found() -> None:
    known = Known()
    known.record.over()
    assert known.found() == ["end"]
    known.ends(GoalStatus.EXECUTING, GoalStatus.ABORTED)
    known.ends(GoalStatus.ABORTED)
    assert known.found() == ["end", "end"]


def test_a_success_without_a_result_is_found() -> None:
    known = Known()
    known.ends(GoalStatus.EXECUTING, GoalStatus.SUCCEEDED)
    assert known.found() == ["end"]


def test_a_status_that_cannot_follow_is_found() -> None:
    known = Known()
    known.record.changed(known.truth, GoalStatus.SUCCEEDED)
    assert known.found() == ["status"]


def test_a_status_that_goes_back_is_found() -> None:
    known = Known()
    known.view.status(GoalStatus.CANCELING)
    known.view.status(GoalStatus.EXECUTING)
    assert known.found() == ["status"]


def test_a_gap_that_nobody_has_told_is_found() -> None:
    known = Known()
    known.truth.count = 5
    known.view.feedback(Step(1), 0)
    known.view.feedback(Step(3), 1)
    assert known.found() == []
    known.view.feedback(Step(5), 1)
    assert known.found() == ["feedback"]


def test_feedback_that_comes_again_or_was_never_yielded_is_found() -> None:
    known = Known()
    known.truth.count = 1
    known.view.feedback(Step(1), None)
    known.view.feedback(Step(1), None)
    known.view.feedback(Step(2), None)
    assert known.found() == ["feedback", "feedback"]


def test_feedback_that_is_missing_at_the_end_is_found() -> None:
    known = Known()
    known.truth.count = 2
    known.view.feedback(Step(1), 0)
    known.ends(GoalStatus.EXECUTING, GoalStatus.ABORTED)
    known.view.status(GoalStatus.ABORTED)
    known.view.end_of_feedback(0)
    assert known.found() == ["feedback"]


def test_an_outcome_that_is_not_the_servers_is_found() -> None:
    known = Known()
    known.ends(GoalStatus.EXECUTING, GoalStatus.ABORTED)
    known.view.outcome(Outcome(GoalStatus.ABORTED))
    assert known.found() == []
    known.view.outcome(Outcome(GoalStatus.ABORTED, Done(1, 1)))
    assert known.found() == ["outcome"]


def test_a_goal_that_is_forgotten_too_early_is_found() -> None:
    known = Known()
    known.view.outcome(Outcome(GoalStatus.UNKNOWN))
    assert set(known.found()) == {"status", "outcome"}


def test_a_cancel_of_a_goal_that_is_not_canceling_is_found() -> None:
    known = Known()
    info = GoalInfo(GOAL, 1, GoalStatus.CANCELING)
    known.record.cancel_answered(CancelAnswer(CancelCode.NONE, (info,)), GOAL, 10.0, None)
    assert known.found() == ["cancel"]


def test_a_goal_that_is_canceled_though_nobody_asked_is_found() -> None:
    known = Known(next(s for s in range(99) if scenario_of(s).server.orphans == "keep"))
    known.ends(GoalStatus.EXECUTING, GoalStatus.CANCELING, GoalStatus.CANCELED)
    assert known.found() == ["cancel"]


def test_a_watcher_who_misses_a_status_is_found() -> None:
    known = Known()
    known.ends(GoalStatus.EXECUTING, GoalStatus.ABORTED)
    watch = Watch(known.record, known.client, exact=True)
    watch.info(GoalInfo(GOAL, 1, GoalStatus.ACCEPTED), is_known=False)
    watch.info(GoalInfo(GOAL, 1, GoalStatus.ABORTED), is_known=False)
    watch.feedback(GOAL, 1, Step(1))
    assert known.found() == ["status", "feedback"]


def test_the_log_is_left_as_it_was() -> None:
    logger = logging.getLogger("fibaction")
    before = logger.level, logger.propagate, list(logger.handlers)
    simulate(scenario_of(0))
    assert (logger.level, logger.propagate, list(logger.handlers)) == before
