"""`python -m tests.tools.benchmarks.watched [URL]`: what watchers cost a server, in turns in one
process.

It prints goals and feedback messages per second of a server and its client without watchers, with
one that does nothing, with metrics, with a recording, and with both; and their ratios to none.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter

import anyio

from fibaction import ActionServer, Watcher, connect, serve
from fibaction.border.abc import FeedbackItem
from fibaction.observe.metrics import Metrics
from fibaction.observe.recordings.recorder import Recorder
from fibaction.words.goals import GoalID
from tests.tools.benchmarks.inprocess import ACTION, Goal, count

ROUNDS = 5
GOALS = 1000
MESSAGES = 100_000


class Nothing(Watcher):
    """A watcher that is told of feedback, and does nothing."""

    def feedback(self, action: str, goal_id: GoalID, item: FeedbackItem) -> None:
        pass


@contextmanager
def none(folder: Path) -> Iterator[list[Watcher]]:
    yield []


@contextmanager
def nothing(folder: Path) -> Iterator[list[Watcher]]:
    yield [Nothing()]


@contextmanager
def metrics(folder: Path) -> Iterator[list[Watcher]]:
    yield [Metrics()]


@contextmanager
def recording(folder: Path) -> Iterator[list[Watcher]]:
    path = folder / "recording.jsonl"
    with Recorder(path) as recorder:
        yield [recorder]
    path.unlink()
    assert not recorder.dropped, f"{recorder.dropped} messages are not in the recording"


@contextmanager
def both(folder: Path) -> Iterator[list[Watcher]]:
    with recording(folder) as watchers:
        yield [Metrics(), *watchers]


WAYS: dict[str, Callable[[Path], AbstractContextManager[list[Watcher]]]] = {
    "none": none,
    "nothing": nothing,
    "metrics": metrics,
    "recording": recording,
    "both": both,
}


async def rates(watchers: list[Watcher], url: str) -> tuple[float, float]:
    """Return the goals and the feedback messages per second."""
    async with (
        serve(ActionServer(ACTION, count), url, watchers=watchers) as (where,),
        connect(where, ACTION) as client,
    ):
        await client.call(Goal(1000))
        start = perf_counter()
        for _ in range(GOALS):
            await client.call(Goal(0))
        middle = perf_counter()
        async with client.send_goal(Goal(MESSAGES)) as goal:
            seen = len([one async for one in goal.feedback])
        assert seen == MESSAGES
        return GOALS / (middle - start), MESSAGES / (perf_counter() - middle)


async def run(url: str) -> None:
    """Measure all ways in turns, and print them."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in WAYS}
    with TemporaryDirectory() as folder:
        for _ in range(ROUNDS):
            for name, way in WAYS.items():
                with way(Path(folder)) as watchers:
                    found[name].append(await rates(watchers, url))
    print(f"{'':10} {'goals/s':>9} {'ratio':>6} {'feedback/s':>11} {'ratio':>6}")
    for name, rounds in found.items():
        goals, feedback = (median(column) for column in zip(*rounds, strict=True))
        pairs = list(zip(rounds, found["none"], strict=True))
        ratios = [median(one[at] / bare[at] for one, bare in pairs) for at in (0, 1)]
        print(f"{name:10} {goals:9,.0f} {ratios[0]:6.2f} {feedback:11,.0f} {ratios[1]:6.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url", nargs="?", default="tcp://127.0.0.1:0")
    anyio.run(run, parser.parse_args().url)


if __name__ == "__main__":
    main()
