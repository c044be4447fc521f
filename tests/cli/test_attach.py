"""`attach`: follow a goal of another client."""

from __future__ import annotations

import json
import signal
from typing import Any, cast

import anyio
import pytest

from fibaction import GoalID, ProtocolError, connect, serve
from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalStream
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs.attach import attach
from tests.cli.conftest import Run, Start, detached
from tests.cli.served import counter
from tests.support.processes import ended, lines_until

ID = GoalID(b"\x01" * 16)


def test_attach_shows_what_comes_and_ends_as_the_goal_does(
    started: Start, here: Run, tcp: str
) -> None:
    goal_id = detached(here, tcp, "wait", "{seconds: 60, steps: 600}")
    process = started("attach", goal_id[:8], url=tcp)
    lines = lines_until("step: step", process)
    here("cancel", goal_id, url=tcp)
    code, out, err = ended(process)

    assert (code, err) == (ExitCode.CANCELED, "")
    assert lines[0] == f"Goal accepted with ID: {goal_id}\n"
    assert out.endswith("Goal finished with status: CANCELED (asked to stop)\n")


def test_attach_to_a_goal_that_has_ended_gives_its_result(here: Run, url: str) -> None:
    goal_id = detached(here, url, "arm/pick", "object_name: cup")
    done = here("attach", goal_id, "arm/pick", "--json", url=url)

    assert (done.code, done.err) == (0, "")
    assert done.json[0]["goal_id"] == goal_id
    assert done.json[-1]["status"] == "SUCCEEDED"
    assert done.json[-1]["result"]["goal"]["object_name"] == "cup"


class GivenUp(ForwardingEndpoint):
    """A server that has given up each goal, with this checkpoint."""

    def __init__(self, inner: Endpoint, checkpoint: bytes) -> None:
        super().__init__(inner)
        self._checkpoint = checkpoint

    async def feedback(self, *arguments: Any, **more: Any) -> GoalStream:
        stream: Any = await super().feedback(*arguments, **more)
        stream.checkpoint = self._checkpoint
        return cast("GoalStream", stream)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("checkpoint", "value", "text"),
    [
        (b"\x04", 4, "given it up, and can run it again from its checkpoint:\n    4\n\n"),
        (b"", None, "given it up, and can run it again from its beginning.\n"),
    ],
)
async def test_the_checkpoint_of_a_goal_that_was_given_up_is_shown(
    checkpoint: bytes, value: int | None, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    url = "inproc://given-up"
    server = counter("one", ["done"])
    async with serve(GivenUp(server, checkpoint), url), connect(url, server.action) as client:
        async with client.send_goal(1) as goal:
            await goal.result()
        await attach(url, str(goal.goal_id), None, full=True, as_json=False)
        assert capsys.readouterr().out.endswith(text)
        await attach(url, str(goal.goal_id), None, full=False, as_json=True)
        last = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert last == {"event": "given_up", "checkpoint": value}


@pytest.mark.asyncio
@pytest.mark.parametrize("checkpoint", [b"\xc1", b"\x91" * 5000, b"\x81\x80\x01"])
async def test_a_checkpoint_that_cannot_be_read_is_one_sentence(checkpoint: bytes) -> None:
    url = "inproc://unreadable-checkpoint"
    server = counter("one", ["done"])
    async with serve(GivenUp(server, checkpoint), url), connect(url, server.action) as client:
        async with client.send_goal(1) as goal:
            await goal.result()
        with pytest.raises(ProtocolError, match=f"the checkpoint of goal {goal.goal_id} is not"):
            await attach(url, str(goal.goal_id), None, full=True, as_json=False)


@pytest.mark.asyncio
async def test_ctrl_c_leaves_the_goal_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    server, url = counter("one", [11, anyio.Event()]), "inproc://attach"
    codes: list[int] = []
    followed = anyio.Event()

    async def follow(*arguments: object, **settings: object) -> GoalStream:
        stream = await feedback(*arguments, **settings)  # type: ignore[arg-type]  # as they came
        followed.set()
        return stream

    async def run() -> None:
        codes.append(await attach(url, "01", None, full=False, as_json=True))

    feedback, server.feedback = server.feedback, follow  # type: ignore[method-assign, assignment]  # to know when
    async with serve(server, url), connect(url, server.action) as client:
        goal = await client.send_goal(1, goal_id=ID)
        with anyio.fail_after(10):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(run)
                await followed.wait()
                signal.raise_signal(signal.SIGINT)
        assert goal.status.is_active

    assert codes == [ExitCode.INTERRUPTED]
    out, err = capsys.readouterr()
    assert err == f"The goal {ID} was left as it is.\n"
    assert json.loads(out.splitlines()[0])["event"] == "accepted"
