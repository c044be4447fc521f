"""A server that sends whatever could harm a command, for tests that start it as a process.

    python -m tests.cli.hostile_server KIND...

It prints its URL, and stops on SIGTERM. Each kind is an action of that name, or many of them.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator, Iterator
from functools import partial
from signal import SIGTERM
from typing import Any

import anyio

from fibaction import Action, ActionInfo, ActionServer, GoalHandle, serve
from fibaction.border.abc import Endpoint, ForwardingEndpoint

LONG = "x" * 1_000_000
CONTROL = "\x1b[2J\x1b]0;title\x07\u202e\r\n"
ANYTHING: Action[Any, Any, Any] = Action("anything", goal=dict, feedback=list, result=str)


class _Described(ForwardingEndpoint):
    """An action with any description."""

    def __init__(self, inner: Endpoint, info: ActionInfo) -> None:
        super().__init__(inner)
        self._info = info

    @property
    def info(self) -> ActionInfo:
        return self._info


def doubled(levels: int) -> dict[str, Any]:
    definitions = {
        f"{level}": {"anyOf": [{"$ref": f"#/$defs/{level + 1}"}] * 2} for level in range(levels)
    }
    return {"$ref": "#/$defs/0", "$defs": {**definitions, f"{levels}": False}}


def nested(levels: int) -> dict[str, Any]:
    schema: dict[str, Any] = {}
    for _ in range(levels):
        schema = {"items": schema}
    return schema


SCHEMAS: dict[str, dict[str, Any]] = {
    "cycle": {"$ref": "#"},
    "deep": nested(150),
    "doubled": doubled(60),
    "pattern": {
        "properties": {"text": {"type": "string", "pattern": "^(a+)+$"}},
        "patternProperties": {"^(a+)+$": {}},
    },
    "defaults": {"properties": {f"f{i}": {"default": LONG} for i in range(10)}},
    "odd": {"type": 5, "properties": [], "required": {"a": 1}},
    "names": {"properties": {f"{LONG}{i}{CONTROL}": {"type": "null"} for i in range(3)}},
}


async def run(goal: GoalHandle[Any]) -> AsyncGenerator[Any, None]:
    """Send much and wide feedback, or a goal that never ends."""
    match goal.request.get("do"):
        case "wide":
            yield [{f"{i}": 1 for i in range(100_000)}]
        case "nested":
            yield [[[[i] * 100] * 100] * 100 for i in range(3)]
        case "text":
            yield [LONG, {LONG: LONG}]
        case _:
            yield []
            await anyio.sleep_forever()
    yield LONG + CONTROL


def endpoints(kinds: list[str]) -> Iterator[Endpoint]:
    for kind in kinds:
        server = ActionServer(ANYTHING, run, shutdown_timeout=0.5)
        if kind == "many":
            for number in range(2000):
                name = f"{number}{CONTROL}{'y' * 500}"
                yield _Described(server, ActionInfo(name, f"{name}/action/T"))
        elif "://" in kind:
            yield _Described(server, ActionInfo(kind[:4], goal={"$ref": kind}))
        else:
            yield _Described(server, ActionInfo(kind, goal=SCHEMAS.get(kind, {})))


async def main(kinds: list[str]) -> None:
    with anyio.open_signal_receiver(SIGTERM) as signals:
        async with serve(list(endpoints(kinds)), "tcp://127.0.0.1:0") as (url,):
            print(url, flush=True)
            await anext(signals)


if __name__ == "__main__":
    anyio.run(partial(main, sys.argv[1:]))
