"""Record a conversation of a client of this release over TCP, which later servers must understand.

    python -m tests.wire.record_conversation

It writes `tests/wire/recorded/version_N.txt`, where N is the version of the protocol: each frame in
a line, in the order in which they passed, `>` from the client and `<` from the server. A version
that was published is never recorded again.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import anyio
from anyio.abc import ByteStream, SocketAttribute, SocketStream

from fibaction import (
    Action,
    ActionServer,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalRejected,
    connect,
    serve,
)
from fibaction.wire.frames import FrameReader, framed
from fibaction.wire.messages import VERSION

RECORDED = Path(__file__).with_name("recorded")
COUNT = Action("count", goal=int, feedback=int, result=str)
UNTIL_CANCELED, REJECTED = 100, 1000
HEARTBEAT = 10.0
DONE, CANCELED, REFUSED = (GoalID(bytes(15) + bytes([number])) for number in (1, 2, 3))


def on_goal(goal: int) -> None:
    if goal == REJECTED:
        raise GoalRejected("too many")


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    for number in range(min(goal.request, 3)):
        yield number
    if goal.request == UNTIL_CANCELED:
        try:
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            raise GoalCanceled(result="counted to 2") from None
    yield f"counted to {goal.request - 1}"


def server() -> ActionServer[int, int, str]:
    """Return the server of the conversation."""
    return ActionServer(COUNT, count, on_goal=on_goal)


async def talk(url: str) -> None:
    """Use what clients use: the list, a goal with feedback, a rejection, a cancel, the statuses."""
    # So rarely that a busy machine sends none of these meanwhile.
    async with connect(url, COUNT, heartbeat=HEARTBEAT) as client:
        await client.wait_for_server()
        async with client.send_goal(3, goal_id=DONE) as goal:
            assert [number async for number in goal.feedback] == [0, 1, 2]
            assert await goal.result() == "counted to 2"
        with suppress(GoalRejected):
            await client.send_goal(REJECTED, goal_id=REFUSED)
        async with client.send_goal(UNTIL_CANCELED, goal_id=CANCELED) as goal:
            await anext(goal.feedback)
            await goal.cancel()
            assert (await goal.outcome()).result == "counted to 2"
        again = await client.attach(DONE)
        assert await again.result() == "counted to 2"
        assert {known.goal_id for known in await client.goals()} == {DONE, CANCELED}


async def frames(stream: ByteStream) -> AsyncGenerator[bytes, None]:
    """Yield each frame of a stream, without its header."""
    reader = FrameReader()
    async for part in stream:
        for frame in reader.feed(part):
            yield frame


async def _pass_on(source: ByteStream, target: ByteStream, note: Callable[[bytes], None]) -> None:
    async for frame in frames(source):
        note(frame)
        await target.send(framed([frame]))
    await target.send_eof()


async def record() -> list[str]:
    """Return the lines of a conversation."""
    lines: list[str] = []

    async def between(port: int, client: SocketStream) -> None:
        async with client, await anyio.connect_tcp("127.0.0.1", port) as there:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(
                    _pass_on, client, there, lambda one: lines.append(f"> {one.hex()}")
                )
                tasks.start_soon(
                    _pass_on, there, client, lambda one: lines.append(f"< {one.hex()}")
                )

    async with (
        serve(server(), "tcp://127.0.0.1:0") as (url,),
        await anyio.create_tcp_listener(local_host="127.0.0.1") as listener,
        anyio.create_task_group() as tasks,
    ):
        port = int(url.rpartition(":")[2])
        tasks.start_soon(listener.serve, partial(between, port))
        here = listener.extra(SocketAttribute.local_port)
        await talk(f"tcp://127.0.0.1:{here}")
        tasks.cancel_scope.cancel()
    return lines


def main() -> None:
    RECORDED.mkdir(exist_ok=True)
    path = RECORDED / f"version_{VERSION}.txt"
    path.write_text("\n".join(anyio.run(record)) + "\n", encoding="utf-8")
    print(f"{path.name} is recorded")


if __name__ == "__main__":
    main()
