"""`workers`: the workers of a fleet."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import msgspec
import pytest

from fibaction import WorkerInfo
from fibaction.border.abc import Connection, Endpoint
from fibaction.cli.verbs import workers
from fibaction.cli.verbs.workers import lines_of, list_workers, note_unreadable

NOW = 1_800_000_000
WORKERS = [
    WorkerInfo("arm-1", ("pick", "/place"), (NOW - 90) * 10**9, 3, has_room=False, version="1.2.0"),
    WorkerInfo("idle \x1b[2J", (), (NOW - 5) * 10**9),
]


class _Fleet(Connection):
    """A connection to a fleet with some workers."""

    def __init__(self, found: list[WorkerInfo]) -> None:
        self._found = found

    def endpoint(self, action: object) -> Endpoint:
        raise NotImplementedError

    async def actions(self) -> list[object]:  # type: ignore[override]  # not asked for here
        raise NotImplementedError

    async def workers(self) -> list[WorkerInfo]:
        return self._found


def with_workers(monkeypatch: pytest.MonkeyPatch, found: list[WorkerInfo]) -> None:
    @asynccontextmanager
    async def connect(url: str) -> AsyncGenerator[Connection, None]:
        assert url == "nats://broker/robots?token=secret"
        yield _Fleet(found)

    monkeypatch.setattr(workers, "connect", connect)


def test_workers_are_told_in_columns() -> None:
    assert lines_of(WORKERS, NOW) == [
        "WORKER        ROOM  GOALS     JOINED  ACTIONS",
        "arm-1         no        3   90 s ago  /pick, /place",
        "idle \\x1b[2J  yes       0  5.0 s ago  -",
    ]


@pytest.mark.asyncio
async def test_workers_as_json_are_one_value_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_workers(monkeypatch, WORKERS[:1])
    await list_workers("nats://broker/robots?token=secret", as_json=True)
    assert capsys.readouterr().out == (
        '{"name":"arm-1","actions":["pick","/place"],"since":1799999910000000000,"goals":3,'
        '"has_room":false,"unreadable":{},"version":"1.2.0"}\n'
    )


@pytest.mark.asyncio
async def test_goals_that_no_worker_can_read_are_counted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    counts: list[dict[str, int]] = [{"pick": 3, "place": 1, "drop": 2}, {"pick": 4, "place": 1}]
    actions = ("pick", "place"), ("pick", "place", "drop")
    found = [
        WorkerInfo(str(number), serves, 0, unreadable=unreadable)
        for number, (serves, unreadable) in enumerate(zip(actions, counts, strict=True))
    ]
    found[0] = msgspec.structs.replace(found[0], actions=("pick", "place", "drop"))
    with_workers(monkeypatch, found)
    await list_workers("nats://broker/robots?token=secret", as_json=False)
    rest = "that no worker here can read: start a worker of the version that accepted them, or end"
    assert capsys.readouterr().err.splitlines() == [
        f"3 waiting goals of /pick {rest} them with unreadable='abort'",
        f"1 waiting goal of /place {rest} them with unreadable='abort'",
    ]
    note_unreadable(found, {"place"})
    assert capsys.readouterr().err.startswith("1 waiting goal of /place ")


@pytest.mark.asyncio
async def test_an_empty_fleet_is_a_remark_without_the_settings_of_the_url(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_workers(monkeypatch, [])
    assert await list_workers("nats://broker/robots?token=secret", as_json=False) == 0
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "There are no workers at nats://broker/robots.\n")
