"""One action, from its definition to a result and to a cancel, all in one process."""
# ruff: noqa: D101, D103 - the names here need no explanation

import asyncio

from msgspec import Struct

from fibaction import Report, action, connect, serve


class Feedback(Struct):
    walked: int


class Result(Struct):
    total: int


@action
async def walk(report: Report[Feedback], metres: int) -> Result:
    for metre in range(1, metres + 1):
        await asyncio.sleep(0.2)  # a cancel is raised here
        await report(Feedback(walked=metre))
    return Result(total=metres)


async def main() -> None:
    async with serve(walk, "inproc://demo"), connect("inproc://demo", walk) as client:
        print(await client.call(3, on_feedback=print))
        async with client.send_goal(metres=10) as goal:
            async for feedback in goal.feedback:
                if feedback.walked == 2:
                    await goal.cancel()
            print((await goal.outcome()).status)


asyncio.run(main())
