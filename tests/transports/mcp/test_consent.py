"""The questions to the user before something moves."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from mcp_types import (
    CallToolResult,
    ClientCapabilities,
    ElicitationCapability,
    ElicitResult,
    ErrorData,
    FormElicitationCapability,
    InputRequiredResult,
    ListRootsResult,
    UrlElicitationCapability,
)

from fibaction.schema.payload import JsonCodec
from fibaction_transports._agents import robot_actions
from fibaction_transports._agents.robot_actions import UnshownGoal, goal_text
from fibaction_transports.mcp import AgentPolicy, consent
from tests.transports.driving_robot import Drive
from tests.transports.mcp.robot import (
    MODES,
    YES,
    Mode,
    Rounds,
    robot_and_talk,
    sent_by_others,
    text_of,
)

pytestmark = pytest.mark.asyncio
both = pytest.mark.parametrize("mode", MODES)


@both
async def test_the_user_is_asked_before_each_goal_and_sees_all_of_it(mode: Mode) -> None:
    async with robot_and_talk(mode, answer="accept") as (robot, made):
        assert (await made.data("arm-drive", meters=3))["status"] == "SUCCEEDED"
        assert made.asked == [
            'Send this goal to the action arm/drive?\n\n{\n  "meters": 3,\n  "speed": 0.5\n}'
        ]
        await made.data("arm-drive", meters=3)
        await made.data("send_goal", tool="arm-drive", goal={"meters": 4})
        assert len(made.asked) == 3
        assert robot.sent == [Drive(3), Drive(3), Drive(4)]


@both
@pytest.mark.parametrize(
    ("answer", "text"),
    [("decline", "the user has declined"), ("cancel", "closed the question without an answer")],
)
async def test_without_a_yes_nothing_is_sent(mode: Mode, answer: Any, text: str) -> None:
    async with robot_and_talk(mode, answer=answer) as (robot, made):
        assert text in await made.error("arm-drive", meters=3)
        assert text in await made.error("send_goal", tool="arm-drive", goal={"meters": 3})
        assert len(made.asked) == 2
        assert robot.sent == []


@both
async def test_a_client_that_cannot_ask_sends_nothing_but_what_is_permitted(mode: Mode) -> None:
    policy = AgentPolicy(unasked=("count",))
    async with robot_and_talk(mode, policy) as (robot, made):
        text = await made.error("arm-drive", meters=3)
        assert text.startswith("Nothing was sent: the user must agree to it first, and this client")
        assert "--" not in text  # a model that can run commands must not help itself
        assert "must agree" in await made.error("send_goal", tool="arm-drive", goal={"meters": 3})
        assert (await made.data("count", goal=1))["result"] == "x"
        tools = {tool.name: tool for tool in (await made.client.list_tools()).tools}
        assert "The user is asked" in (tools["arm-drive"].description or "")
        assert "The user is asked" not in (tools["count"].description or "")
        assert robot.sent == []


@both
async def test_a_tool_sends_no_goal_that_is_too_long_to_be_shown(
    mode: Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports._agents.robot_actions.LONGEST_GOAL", 10)
    async with robot_and_talk(mode, answer="accept") as (robot, made):
        assert "can be shown 10" in await made.error("arm-drive", meters=3)
        assert made.asked == []
        assert robot.sent == []


@both
async def test_what_would_be_rejected_at_once_is_not_asked_about(mode: Mode) -> None:
    async with robot_and_talk(mode, answer="accept") as (_, made):
        await made.error("arm-drive", meters="far")
        await made.error("fly")
        assert made.asked == []


@both
async def test_the_user_is_asked_before_the_goal_of_another_is_canceled(mode: Mode) -> None:
    async with robot_and_talk(mode, answer="accept") as (robot, made):
        other = await sent_by_others(robot, 100)
        await robot.waits.wait()
        assert (await made.data("cancel_goal", goal_id=str(other.goal_id)))["status"] == "CANCELED"
        (question,) = made.asked
        assert question == (
            f"Cancel the goal {other.goal_id} of the action arm/drive, which another client has"
            f" sent?"
        )
        assert robot.stopped.is_set()


@both
async def test_an_own_goal_is_canceled_without_a_question(mode: Mode) -> None:
    async with robot_and_talk(mode, answer="accept") as (robot, made):
        sent = await made.data("send_goal", tool="arm-drive", goal={"meters": 100})
        await robot.waits.wait()
        made.asked.clear()
        await made.data("cancel_goal", goal_id=sent["goal_id"])
        assert made.asked == []


# The protocol with a handshake


async def test_a_client_that_fails_to_ask_sends_nothing() -> None:
    async def fail(*_: object) -> ErrorData:
        return ErrorData(code=-32000, message="no window")

    async with robot_and_talk("legacy", answer=fail) as (robot, made):
        assert "the client failed to ask" in await made.error("arm-drive", meters=3)
        assert robot.sent == []


async def test_a_user_who_does_not_answer_is_waited_for_a_limited_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(consent, "QUESTION_TIMEOUT", 0.02)

    async def never(*_: object) -> ElicitResult:
        await anyio.sleep_forever()
        raise AssertionError

    async with robot_and_talk("legacy", answer=never) as (robot, made):
        assert "there was no answer in 0.02 s" in await made.error("arm-drive", meters=3)
        assert robot.sent == []


# The protocol without one: the client calls again, with the answer and what the server gave it


async def test_an_answer_counts_once_and_for_the_same_goal_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with robot_and_talk("auto", answer="accept") as (robot, made):
        rounds = Rounds(made)
        state = await rounds.ask(3)
        # For another goal; then the question is gone, for the first one, too.
        again = await rounds.call(50, input_responses=YES, request_state=state)
        assert isinstance(again, InputRequiredResult)
        again = await rounds.call(3, input_responses=YES, request_state=state)
        assert isinstance(again, InputRequiredResult)
        # Made up, or none.
        for made_up in ("", "yes", None):
            again = await rounds.call(3, input_responses=YES, request_state=made_up)
            assert isinstance(again, InputRequiredResult)
        assert robot.sent == []

        state = await rounds.ask(3)
        done = await rounds.call(3, input_responses=YES, request_state=state)
        assert isinstance(done, CallToolResult)
        assert robot.sent == [Drive(3)]
        again = await rounds.call(3, input_responses=YES, request_state=state)
        assert isinstance(again, InputRequiredResult)

        monkeypatch.setattr(robot_actions, "QUESTION_TIMEOUT", -1.0)
        state = await rounds.ask(3)
        again = await rounds.call(3, input_responses=YES, request_state=state)
        assert isinstance(again, InputRequiredResult)
        assert robot.sent == [Drive(3)]


async def test_a_second_call_without_an_answer_sends_nothing() -> None:
    async with robot_and_talk("auto", answer="accept") as (robot, made):
        rounds = Rounds(made)
        for answers in (None, {"consent": ListRootsResult(roots=[])}):
            state = await rounds.ask()
            result = await rounds.call(input_responses=answers, request_state=state)
            assert isinstance(result, CallToolResult)
            assert "has not answered the question" in text_of(result)
        assert robot.sent == []


@pytest.mark.parametrize(
    ("elicitation", "can"),
    [
        (ElicitationCapability(), True),
        (ElicitationCapability(form=FormElicitationCapability()), True),
        (
            ElicitationCapability(form=FormElicitationCapability(), url=UrlElicitationCapability()),
            True,
        ),
        (ElicitationCapability(url=UrlElicitationCapability()), False),
        (None, False),
    ],
)
async def test_a_client_says_whether_it_can_ask(
    elicitation: ElicitationCapability | None, can: bool
) -> None:
    assert consent._can_ask(ClientCapabilities(elicitation=elicitation)) is can
    assert not consent._can_ask(None)


# The goal in the question

ANYTHING = JsonCodec({})


async def test_the_fields_that_only_the_server_knows_are_named() -> None:
    stamp = {"type": "object", "properties": {"at\u202e": {}, "by": {"default": "me"}}}
    goals = JsonCodec({"type": "object", "properties": {"id": {}, "stamp": stamp}})
    message = goals.complete({"stamp": {}})
    assert goal_text(message, goals).split("\n")[-2:] == [
        "",
        "The server fills in: id, stamp.at\\u202e",
    ]
    assert "fills in" not in goal_text({"id": 1}, JsonCodec({"properties": {"id": {}}}))


async def test_a_goal_is_shown_without_characters_that_deceive() -> None:
    text = goal_text({"to": "the door\u202eroot eht", "note": "a\nb\x1b[2J", "größe": 1}, ANYTHING)
    assert text.split("\n") == [
        "{",
        '  "to": "the door\\u202eroot eht",',
        '  "note": "a\\nb\\u001b[2J",',
        '  "größe": 1',
        "}",
    ]


async def test_a_goal_that_is_too_long_to_be_shown_is_not_sent() -> None:
    with pytest.raises(UnshownGoal, match="has 5014 characters, and the user, who must agree"):
        goal_text({"to": "x" * 4998 + "\n"}, ANYTHING)
    with pytest.raises(UnshownGoal, match="because the user cannot see it"):
        goal_text({"to": object()}, ANYTHING)
