"""A few seconds of simulation, and the command that runs more of it."""

from __future__ import annotations

import math
import os
import secrets
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.simulation import __main__ as command
from tests.simulation.executors import EXECUTORS
from tests.simulation.generator import scenario_of
from tests.simulation.invariants import Violation
from tests.simulation.scenario import (
    ATTACKS,
    DEEDS,
    KINDS,
    SUCCEEDING,
    Attack,
    ClientPlan,
    Deed,
    HostilePlan,
    Scenario,
    ServerPlan,
    Work,
)
from tests.simulation.store_generator import WRITES
from tests.simulation.streams import Weather
from tests.simulation.world import Report, simulate
from tests.support.memory_store import Fate

FIXED = (*range(40), 4044379467)
"""Seeds that are run each time; those of many digits have found a bug."""
FRESH = 20
"""How many seeds are run that nobody has seen before."""
CHECKS = {
    "told",
    "ends told",
    "cancels told",
    "checkpoints",
    "restored checkpoints",
    "starts",
    "starts after a crash",
    "goals found active",
    "goals found after a stop",
    "ends at a restart",
}
"""The kinds of checks of what is kept."""
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


def test_the_last_client_that_said_hello_is_not_kept_after_it_has_left() -> None:
    # The task that waits for hellos kept it, and what its goals hold counted until the next one.
    work = Work(100, "busy", steps=5, size=500)
    attacks = (
        Attack(6.0, "send", work, count=40, credit=1000),
        Attack(6.5, "wrong message", work, target=2),
    )
    plan = HostilePlan("hostile-0", Weather(buffer=700), attacks, reads="never")
    honest = ClientPlan("client-0", Weather(), deeds=(Deed(0.0, "send", Work(1)),))
    check(simulate(Scenario(0, "calm", ServerPlan(), (honest,), hostile=(plan,), calls_back=True)))


# The same again


def test_a_seed_is_the_same_run_in_every_process() -> None:
    program = (
        "from tests.simulation.world import simulate\n"
        "from tests.simulation.generator import scenario_of\n"
        "print(*(simulate(scenario_of(seed)).digest for seed in range(20, 30)))"
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
    assert {deed.work.kind for deed in deeds} == {*KINDS, *SUCCEEDING}
    assert set(EXECUTORS) == {*KINDS, *SUCCEEDING}
    assert len(faults) == 8
    assert all(not one.faults for one in scenarios if one.climate == "calm")
    assert not any(one.has_restarts for one in scenarios if one.climate == "gentle")


def test_hostile_clients_are_of_all_kinds_in_half_of_the_scenarios() -> None:
    scenarios = [scenario_of(seed) for seed in range(1000)]
    hostile = [plan for one in scenarios for plan in one.hostile]
    attacks = {attack.kind for plan in hostile for attack in plan.attacks}
    assert attacks == {kind for kind, _ in ATTACKS}
    assert {plan.reads for plan in hostile} == {"all", "slowly", "never"}
    assert {plan.leaves for plan in hostile} == {"goodbye", "close", "silence"}
    assert 400 < sum(bool(one.hostile) for one in scenarios) < 600


def test_servers_have_schedules_of_all_kinds_in_half_of_the_scenarios() -> None:
    plans = [scenario_of(seed).server.schedule for seed in range(1000)]
    schedules = [plan.schedule() for plan in plans if plan is not None]
    assert 400 < len(schedules) < 600
    assert {one.when_full for one in schedules} == {"reject", "preempt", "replace"}
    for name in ("concurrency", "total", "key", "priority"):
        assert {getattr(one, name) is None for one in schedules} == {True, False}
    for name in ("queue_timeout", "run_timeout"):
        assert {getattr(one, name) < math.inf for one in schedules} == {True, False}
    assert {0.0, math.inf} < {one.handover for one in schedules}


def test_what_a_schedule_does_happens_in_the_scenarios() -> None:
    counts: Counter[str] = Counter()
    seeds = (seed for seed in range(230) if scenario_of(seed).server.schedule is not None)
    for seed in seeds:
        report = simulate(scenario_of(seed))
        check(report)
        counts.update(report.places)
        if all(counts[kind] for kind in report.places):
            break
    assert all(counts.values()), counts


def test_servers_have_stores_of_all_kinds_in_some_of_the_scenarios() -> None:
    plans = [scenario_of(seed).server.store for seed in range(1000)]
    stores = [plan for plan in plans if plan is not None]
    assert 200 < len(stores) < 400
    assert {one.recovery for one in stores} == {"abort", "rerun", "sync", "async"}
    assert {one.at_stop for one in stores} == {"abort", "keep"}
    faults = {(fault.what, fault.fate) for one in stores for fault in one.faults}
    assert {fate for _, fate in faults} == {*Fate} - {Fate.KEPT, Fate.TAKEN}
    assert {what for what, _ in faults} == {*WRITES}
    assert all(scenario_of(seed, store=True).server.store is not None for seed in range(9))


def test_servers_die_and_fail_at_each_write_in_the_scenarios() -> None:
    seen: set[str] = set()
    wanted = {"accept", "begin", "cancel", "checkpoint", "end"}
    wanted |= {fate.value for fate in Fate if fate not in (Fate.KEPT, Fate.TAKEN)} | CHECKS
    for seed in range(200):
        report = simulate(scenario_of(seed, store=True))
        check(report)
        seen |= {word for crash in report.crashes for word in crash.split()} | {*report.checks}
        if wanted <= seen:
            break
    assert wanted <= seen, wanted - seen


# Hostile clients alone: each attack of each kind, against one honest client that calls


@pytest.mark.parametrize("reads", ["all", "never"])
@pytest.mark.parametrize("kind", [kind for kind, _ in ATTACKS])
def test_an_attack_leaves_an_honest_client_and_the_server_as_they_were(
    kind: str, reads: Literal["all", "never"]
) -> None:
    deeds = tuple(
        Deed(at, what, Work(key, "steady", steps=30, pause=0.1))
        for key, (at, what) in enumerate([(0.0, "send"), (0.5, "call"), (1.0, "events")])
    )
    attacks = tuple(
        Attack(0.2 + number / 10, kind, Work(100 + number), count=40, target=number, credit=number)
        for number in range(3)
    )
    plan = HostilePlan("hostile-0", Weather(), attacks, reads=reads)
    server = ServerPlan(follows=10, requests=30, goals=60, asks_for_tokens=True)
    honest = ClientPlan("client-0", Weather(), deeds=deeds)
    check(simulate(Scenario(0, "calm", server, (honest,), hostile=(plan,))))


# The command


def test_the_command_replays_a_seed(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main("--seed", "3", "--trace") == 0
    printed = capsys.readouterr().out
    assert "server 1 starts" in printed
    assert simulate(scenario_of(3)).digest in printed


def test_a_trace_is_of_one_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.main("--trace")
    error = capsys.readouterr().err
    assert error.endswith("--trace needs --seed: it prints the events of one scenario\n")


def test_the_command_counts_what_it_has_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main("--seconds", "0.3", "--from", "0") == 0
    printed = capsys.readouterr().out
    assert "first seed: 0" in printed
    assert '"scenarios": ' in printed


def test_the_command_tells_how_to_see_a_failure_again(
    capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    def failing(scenario: Any) -> Report:
        wrong = Violation("once", "it ran twice", 1.0)
        return Report(scenario, [wrong], ["a", "b"], 0, 0, 0, 0, 1.0, {}, {}, {})

    monkeypatch.setattr(command, "simulate", failing)
    assert command.main("--seconds", "5", "--from", "77") == 1
    printed = capsys.readouterr().out
    assert "it ran twice" in printed
    assert "python -m tests.simulation --seed 77 --trace" in printed
