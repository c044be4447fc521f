from __future__ import annotations

from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import ActionServer, GoalHandle, GoalRejected, connect, serve
from fibaction.action_files import InterfaceError, action_source, load_action
from fibaction_transports.inprocess import InProcessTransport
from tests.support.interface_files import write

FILES = Path(__file__).parents[1] / "action_files"
COUNT = FILES / "plain" / "Count.action"


def load(**settings: Any) -> Any:
    return load_action(COUNT, search=[FILES], **settings)


def test_an_action_is_made_from_a_file() -> None:
    action = load()

    assert action.name == "count"
    assert action.type_name == ""
    assert msgspec.to_builtins(action.goal.type(order=3)) == {"order": 3, "step": {"size": 1}}
    assert msgspec.to_builtins(action.feedback.type()) == {"used": {"name": ""}}
    assert msgspec.to_builtins(action.result.type()) == {"sequence": []}


def test_a_given_name_and_type_are_used() -> None:
    action = load(name="arm/count", type_name="robot_msgs/action/Count")

    assert (action.name, action.type_name) == ("arm/count", "robot_msgs/action/Count")


@pytest.mark.anyio
async def test_a_loaded_action_is_served_and_checks_its_limits() -> None:
    action = load()

    async def count(goal: GoalHandle[Any]) -> AsyncGenerator[Any, None]:
        yield action.feedback.type()
        yield action.result.type(sequence=list(range(goal.request.order)))

    transport = InProcessTransport()
    with anyio.fail_after(30):
        async with (
            serve(ActionServer(action, count), transport),
            connect(transport, action) as client,
        ):
            result = await client.call(action.goal.type(order=3))
            with pytest.raises(GoalRejected, match=r"goal\.order: 2147483648 is greater"):
                await client.call(action.goal.type(order=2**31))

    assert result.sequence == [0, 1, 2]


def test_the_source_makes_the_same_action() -> None:
    source = action_source(COUNT, name="tally", search=[FILES], type_name="a/action/Count")
    names: dict[str, Any] = {"__name__": "tally_types"}
    exec(compile(source, "tally_types.py", "exec", dont_inherit=True), names)

    action = load(name="tally", type_name="a/action/Count")
    assert names["TALLY"].info == action.info


@pytest.mark.parametrize("make", [load_action, action_source])
def test_a_malformed_file_is_rejected(make: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "int32 order\nint33 size\n---\n---\n")

    with pytest.raises(InterfaceError) as caught:
        make(path)

    assert isinstance(caught.value, ValueError)
    assert (caught.value.path, caught.value.line) == (path, 2)
    assert str(caught.value).startswith(f"{path}:2: expected a type like 'int32'")


@pytest.mark.parametrize("make", [load_action, action_source])
def test_an_invalid_name_or_type_is_rejected(make: Any) -> None:
    with pytest.raises(ValueError, match="an action's name is like"):
        make(COUNT, name="2 much", search=[FILES])
    with pytest.raises(ValueError, match="a type name is like"):
        make(COUNT, type_name="Count", search=[FILES])
    with pytest.raises(FileNotFoundError):
        make(COUNT.with_name("Missing.action"))
