"""The consent of a user before a goal is sent."""

from __future__ import annotations

from typing import Any

import pytest
from a2a.utils.errors import InvalidParamsError, TaskNotCancelableError, TaskNotFoundError

from fibaction_transports._agents import robot_actions
from fibaction_transports.a2a.documents import Document
from fibaction_transports.a2a.goal_messages import answer_in
from tests.transports.a2a.agent_talk import (
    data_of,
    message,
    robot_and_talk,
    state_of,
    talking,
    text_of,
    told,
)
from tests.transports.driving_robot import Drive

pytestmark = pytest.mark.asyncio


async def test_a_goal_is_sent_after_a_yes() -> None:
    async with robot_and_talk(unasked=[]) as (robot, talk):
        assert "A user must agree" in talk.card.skills[0].description
        (asked,) = [one async for one in talk.stream({"meters": 3}, skill="arm-drive")]
        task = asked.task
        assert told(asked) == "task INPUT_REQUIRED"
        assert '"meters": 3,\n  "speed": 0.5' in text_of(task)
        assert robot.sent == []
        assert await talk.get(task.id) == task or state_of(await talk.get(task.id))
        assert [told(one) async for one in talk.subscribe(task.id)] == ["task INPUT_REQUIRED"]
        unclear = await talk.send(text="why?", task=task.id)
        assert state_of(unclear) == "INPUT_REQUIRED"
        done = await talk.send(text="Yes.", task=task.id)
        assert (done.id, state_of(done)) == (task.id, "COMPLETED")
        assert data_of(done.artifacts[0].parts) == {"at": 3}
        assert robot.sent == [Drive(3)]


async def test_a_goal_is_not_sent_after_a_no() -> None:
    async with robot_and_talk(unasked=[]) as (robot, talk):
        task = await talk.send({"meters": 3}, skill="arm-drive")
        done = await talk.send({"consent": False}, task=task.id)
        assert (state_of(done), text_of(done)) == (
            "REJECTED",
            "nothing was sent: the user has declined",
        )
        with pytest.raises(TaskNotFoundError):
            await talk.send(text="yes", task=task.id)
        assert robot.sent == []


async def test_a_question_is_canceled() -> None:
    async with robot_and_talk(unasked=["say"]) as (robot, talk):
        task = await talk.send({"meters": 3}, skill="arm-drive")
        assert state_of(await talk.cancel(task.id)) == "CANCELED"
        with pytest.raises(TaskNotFoundError):
            await talk.get(task.id)
        assert state_of(await talk.send(text="hallo", skill="say")) == "COMPLETED"
        assert robot.sent == []


async def test_a_question_is_of_the_client_that_asked_and_of_the_goal_that_was_shown() -> None:
    async with (
        robot_and_talk(unasked=[], tokens={"b-b-b-b-b-b": "bob"}) as (robot, alice),
        talking(alice.url, "b-b-b-b-b-b") as bob,
    ):
        made = message({"meters": 3}, skill="arm-drive")
        task = await alice.send(made=made)
        other = message({"meters": 50}, skill="arm-drive")
        other.message_id = made.message_id
        for talk, sent in ((bob, other), (bob, made), (alice, other)):
            with pytest.raises(InvalidParamsError, match="another message has this ID"):
                await talk.send(made=sent)
        for forbidden in (
            bob.send(text="yes", task=task.id),
            bob.send(text="no", task=task.id),
            bob.cancel(task.id),
            bob.get(task.id),
        ):
            with pytest.raises(TaskNotFoundError):
                await forbidden
        assert robot.sent == []
        assert (await alice.send(made=made)).id == task.id
        await alice.send(text="yes", task=task.id)
        assert robot.sent == [Drive(3)]


async def test_another_client_cannot_cancel_a_goal_even_if_it_sends_it_again() -> None:
    async with (
        robot_and_talk(unasked=[], tokens={"b-b-b-b-b-b": "bob"}) as (robot, alice),
        talking(alice.url, "b-b-b-b-b-b") as bob,
    ):
        made = message({"meters": 100}, skill="arm-drive")
        task = await alice.send(made=made)
        await alice.send(text="yes", task=task.id, at_once=True)
        assert (await bob.send(made=made)).id == task.id  # a question to bob, who agrees
        await bob.send(text="yes", task=task.id, at_once=True)
        with pytest.raises(TaskNotCancelableError, match="another client has sent the goal"):
            await bob.cancel(task.id)
        assert state_of(await alice.cancel(task.id)) == "CANCELED"
        assert len(robot.sent) == 1


async def test_a_goal_that_the_user_cannot_be_shown_is_not_sent() -> None:
    async with robot_and_talk(unasked=[]) as (_, talk):
        with pytest.raises(InvalidParamsError, match="can be shown 4000"):
            await talk.send(text="x" * 5000, skill="say")


async def test_a_question_expires_and_only_so_many_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_actions, "MOST_QUESTIONS", 1)
    async with robot_and_talk(unasked=[]) as (_, talk):
        one = await talk.send({"meters": 3}, skill="arm-drive")
        two = await talk.send({"meters": 3}, skill="arm-drive")
        with pytest.raises(TaskNotFoundError):
            await talk.get(one.id)
        assert state_of(await talk.get(two.id)) == "INPUT_REQUIRED"
        monkeypatch.setattr(robot_actions, "QUESTION_TIMEOUT", 0)
        late = await talk.send({"meters": 3}, skill="arm-drive")
        with pytest.raises(TaskNotFoundError):
            await talk.get(late.id)


@pytest.mark.parametrize(
    ("data", "answer"),
    [({"consent": True}, True), ({"consent": "yes"}, None), ({}, None), (True, None)],
)
async def test_an_answer_as_data(data: Any, answer: bool | None) -> None:
    assert answer_in([Document("data", data)]) is answer


async def test_an_answer_is_one_part() -> None:
    assert answer_in([]) is None
    assert answer_in([Document("")]) is None
    assert answer_in([Document("text", "YES!")]) is True
