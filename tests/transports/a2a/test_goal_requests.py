"""Goals as tasks, by the client of the SDK over HTTP."""

from __future__ import annotations

from typing import Any

import anyio
import msgspec
import pytest
from a2a.types import (
    DeleteTaskPushNotificationConfigRequest,
    GetExtendedAgentCardRequest,
    GetTaskPushNotificationConfigRequest,
    ListTaskPushNotificationConfigsRequest,
    ListTasksRequest,
    Message,
    Part,
    Role,
    TaskPushNotificationConfig,
    TaskState,
)
from a2a.utils.errors import (
    A2AError,
    ContentTypeNotSupportedError,
    InvalidParamsError,
    PushNotificationNotSupportedError,
    TaskNotCancelableError,
    TaskNotFoundError,
    UnsupportedOperationError,
)
from google.protobuf.json_format import MessageToDict

from fibaction import Action, ActionClient, GoalID, serve
from fibaction.testing import ScriptedServer
from fibaction_transports.a2a import A2aHttpTransport
from tests.support.processes import PATIENCE
from tests.transports.a2a.agent_talk import (
    TOKEN,
    Robot,
    data_of,
    message,
    robot_and_talk,
    state_of,
    talking,
    text_of,
    told,
)
from tests.transports.driving_robot import DRIVE, Drive

pytestmark = pytest.mark.asyncio


async def test_the_card_has_a_skill_for_each_action() -> None:
    async with robot_and_talk() as (_, talk):
        drive, say = talk.card.skills
        assert (drive.id, drive.name, list(drive.tags)) == (
            "arm-drive",
            "arm/drive",
            ["action", "a/action/Drive"],
        )
        assert "Drive straight on." in drive.description
        assert '"required":["meters"]' in drive.description
        assert list(drive.examples) == ['{"meters":0,"speed":0.5}']
        assert list(drive.input_modes) == ["application/json", "text/plain"]
        assert list(say.input_modes) == ["application/json", "text/plain"]
        assert talk.card.capabilities.streaming
        assert talk.card.supported_interfaces[0].url == talk.url
        (extension,) = talk.card.capabilities.extensions
        assert MessageToDict(extension.params)["schemas"]["say"]["result"] == {"type": "string"}


async def test_a_stream_tells_the_whole_life_of_a_goal() -> None:
    async with robot_and_talk() as (robot, talk):
        updates = [one async for one in talk.stream({"meters": 3}, skill="arm-drive")]
        assert [told(one) for one in updates] == [
            "task SUBMITTED",
            "WORKING",
            "1: {'meters': 1.0}",
            "2: {'meters': 2.0}",
            "3: {'meters': 3.0}",
            "result {'at': 3.0}",
            "COMPLETED",
        ]
        assert robot.sent == [Drive(3)]
        second = updates[3].status_update
        assert dict(second.metadata) == {"number": 2, "attempt": 1, "event_id": "2"}
        assert second.status.timestamp.seconds
        task_id = updates[0].task.id
        assert {one.status_update.task_id for one in updates[1:5]} == {task_id}


async def test_a_message_waits_for_the_result() -> None:
    async with robot_and_talk() as (_, talk):
        task = await talk.send({"meters": 3}, skill="arm-drive")
        assert state_of(task) == "COMPLETED"
        assert data_of(task.artifacts[0].parts) == {"at": 3}
        again = await talk.get(task.id)
        assert again == task


async def test_a_message_that_waits_too_long_is_answered_that_the_goal_still_runs() -> None:
    async with robot_and_talk(patience=0.01) as (robot, talk):
        task = await talk.send({"meters": 100}, skill="arm-drive")
        assert state_of(task) in ("SUBMITTED", "WORKING")
        robot.go(100)


async def test_a_goal_of_text_is_sent_as_text() -> None:
    async with robot_and_talk() as (_, talk):
        assert data_of((await talk.send(text="hallo", skill="say")).artifacts[0].parts) == "HALLO"
        assert data_of((await talk.send("moin", skill="say")).artifacts[0].parts) == "MOIN"


async def test_an_action_that_needs_no_goal_takes_an_empty_text() -> None:
    action = Action("home", goal=None, feedback=int, result=str)
    address = A2aHttpTransport(port=0, unasked=["*"], token=TOKEN)
    async with (
        ScriptedServer(action, ["home"]) as server,
        serve(server, address) as (url,),
        talking(url) as talk,
    ):
        assert "text/plain" in talk.card.skills[0].input_modes
        for sent in (message({}), message(text=" ")):
            assert state_of(await talk.send(made=sent)) == "COMPLETED"
        with pytest.raises(InvalidParamsError, match="a text that is JSON"):
            await talk.send(made=message(text="away"))
    assert server.received == [None, None]


async def test_a_single_skill_need_not_be_named() -> None:
    async with robot_and_talk(allow=["say"]) as (_, talk):
        assert [skill.id for skill in talk.card.skills] == ["say"]
        assert data_of((await talk.send(text="hallo")).artifacts[0].parts) == "HALLO"


async def test_a_task_tells_its_newest_feedback_while_it_runs() -> None:
    async with robot_and_talk() as (robot, talk):
        updates = talk.stream({"meters": 100}, skill="arm-drive")
        task_id = (await anext(updates)).task.id
        robot.go(2)
        while told(await anext(updates)) != "2: {'meters': 2.0}":
            pass
        task = await talk.get(task_id)
        assert state_of(task) == "WORKING"
        assert data_of(task.status.message.parts) == {"meters": 2}
        assert task.metadata["event_id"] == "2"
        robot.go(98)
        assert [told(one) async for one in updates][-1] == "COMPLETED"


async def test_a_goal_is_canceled_with_its_partial_result() -> None:
    async with robot_and_talk() as (robot, talk):
        task = await talk.send({"meters": 100}, skill="arm-drive", at_once=True)
        robot.go(1)
        updates = talk.subscribe(task.id)
        while told(await anext(updates)) != "1: {'meters': 1.0}":
            pass
        done = await talk.cancel(task.id)
        assert (state_of(done), text_of(done)) == ("CANCELED", "it has braked")
        assert (done.artifacts[0].name, data_of(done.artifacts[0].parts)) == (
            "partial result",
            {"at": 1},
        )
        rest = [told(one) async for one in updates]
        assert rest == ["WORKING: canceling", "result {'at': 1.0}", "CANCELED: it has braked"]
        with pytest.raises(TaskNotCancelableError, match="the task has ended"):
            await talk.cancel(task.id)


async def test_a_goal_that_ends_without_a_result_has_no_artifact() -> None:
    async with robot_and_talk() as (robot, talk):
        task = await talk.send(text="...", skill="say", at_once=True)
        with anyio.fail_after(PATIENCE):
            await robot.listens.wait()
        running = await talk.get(task.id)
        assert (state_of(running), text_of(running)) == ("WORKING", "")
        assert state_of(await talk.cancel(task.id)) == "CANCELED"
        updates = [told(one) async for one in talk.subscribe(task.id, "0")]
        assert updates == ["task CANCELED", "CANCELED"]


async def test_an_aborted_goal_has_failed_and_a_rejected_one_is_rejected() -> None:
    async with robot_and_talk() as (_, talk):
        failed = await talk.send({"meters": 13}, skill="arm-drive")
        assert (state_of(failed), text_of(failed)) == ("FAILED", "there is a wall")
        assert data_of(failed.artifacts[0].parts) == {"at": 12}
        rejected = await talk.send({"meters": -3}, skill="arm-drive")
        assert (state_of(rejected), text_of(rejected)) == ("REJECTED", "it cannot drive backwards")
        (only,) = [one async for one in talk.stream({"meters": -3}, skill="arm-drive")]
        assert told(only) == "task REJECTED"
        with pytest.raises(TaskNotFoundError):
            await talk.get(rejected.id)


async def test_a_cancel_that_the_server_rejects_is_an_error() -> None:
    async with robot_and_talk() as (robot, talk):
        robot.is_stubborn = True
        task = await talk.send({"meters": 100}, skill="arm-drive", at_once=True)
        with pytest.raises(TaskNotCancelableError, match="rejects the cancel: it is on a slope"):
            await talk.cancel(task.id)
        robot.go(100)


@pytest.mark.parametrize(
    ("goal", "skill", "error", "text"),
    [
        ({"meter": 3}, "arm-drive", InvalidParamsError, 'no field "meter"; did you mean meters'),
        ({"meters": "x"}, "arm-drive", InvalidParamsError, "the goal was not sent: "),
        ({"meters": 2.0**60}, "arm-drive", InvalidParamsError, "does not carry exactly"),
        (3, "say", InvalidParamsError, "the goal was not sent: "),
        ({"meters": 3}, "drive", InvalidParamsError, "no skill 'drive' now; there are: arm-drive"),
        ({"meters": 3}, "", InvalidParamsError, "name the skill in the metadata"),
    ],
)
async def test_a_wrong_goal_is_an_error_that_says_what_is_wrong(
    goal: Any, skill: str, error: type[A2AError], text: str
) -> None:
    async with robot_and_talk() as (robot, talk):
        with pytest.raises(error, match=text):
            await talk.send(goal, skill=skill)
        with pytest.raises(error, match=text):
            [one async for one in talk.stream(goal, skill=skill)]
        assert robot.sent == []


@pytest.mark.parametrize(
    ("text", "skill"),
    [
        ('{"meters": 3}', "arm-drive"),
        ('{"skill": "arm-drive", "goal": {"meters": 3}}', ""),
        (' { "goal": {"meters": 3.0}, "skill": "arm-drive" }', ""),
    ],
)
async def test_a_text_of_an_agent_is_the_goal(text: str, skill: str) -> None:
    async with robot_and_talk() as (robot, talk):
        done = await talk.send(text=text, skill=skill)
        assert [part.text for part in done.artifacts[0].parts] == ["", '{"at":3}']
        assert state_of(await talk.send({"skill": "arm-drive", "goal": {"meters": 3}}))
        assert robot.sent == [Drive(3), Drive(3)]


class Fetch(msgspec.Struct):
    what: str
    count: int = 1


@pytest.mark.parametrize("text", ["two cups", "2", "null", "[1]"])
async def test_a_text_is_the_only_text_field_of_a_goal(text: str) -> None:
    action = Action("fetch", goal=Fetch, feedback=int, result=str)
    address = A2aHttpTransport(port=0, unasked=["*"], token=TOKEN)
    async with (
        ScriptedServer(action, ["here"]) as server,
        serve(server, address) as (url,),
        talking(url) as talk,
    ):
        assert state_of(await talk.send(text=text)) == "COMPLETED"
        assert state_of(await talk.send(text='{"what": "a pen", "count": 2}')) == "COMPLETED"
    assert server.received == [Fetch(text), Fetch("a pen", 2)]


async def test_a_long_result_is_data_only() -> None:
    async with robot_and_talk() as (_, talk):
        (part,) = (await talk.send(text="x" * 10_001, skill="say")).artifacts[0].parts
        assert part.data.string_value == "X" * 10_001


async def test_what_was_said_before_a_text_is_not_the_goal() -> None:
    async with robot_and_talk() as (_, talk):
        said = message(text="[user] said: hallo", skill="say")
        said.parts.append(Part(text="moin"))
        assert data_of((await talk.send(made=said)).artifacts[0].parts) == "MOIN"


async def test_what_is_not_a_goal_is_told_what_would_be_one() -> None:
    async with robot_and_talk() as (robot, talk):
        with pytest.raises(InvalidParamsError, match=r"a text that is JSON, such as {\"meters\":0"):
            await talk.send(text="drive on", skill="arm-drive")
        with pytest.raises(InvalidParamsError, match="or send the goal as"):
            await talk.send(text='{"skill": "fly"}')
        two = message("a", skill="say")
        two.parts.append(two.parts[0])
        for sent in (two, Message(message_id="1", role=Role.ROLE_USER, parts=[Part(raw=b"a")])):
            with pytest.raises(ContentTypeNotSupportedError, match="one part with data, or with"):
                await talk.send(made=sent)
        assert robot.sent == []


async def test_a_message_that_is_sent_again_sends_no_second_goal() -> None:
    async with robot_and_talk() as (robot, talk):
        made = message({"meters": 3}, skill="arm-drive")
        one = await talk.send(made=made)
        two = await talk.send(made=made)
        assert one.id == two.id == made.message_id.replace("-", "")
        assert robot.sent == [Drive(3)]
        made.message_id = "mine"
        assert GoalID.parse((await talk.send(made=made)).id)
        made.message_id = "0" * 32
        assert int((await talk.send(made=made)).id, 16)


async def test_the_context_of_a_task_is_that_of_its_message() -> None:
    async with robot_and_talk() as (_, talk):
        made = message({"meters": 3}, skill="arm-drive")
        made.context_id = "kitchen"
        task = await talk.send(made=made)
        assert task.context_id == "kitchen"
        listed = await talk.client.list_tasks(ListTasksRequest(context_id="kitchen"))
        assert [one.id for one in listed.tasks] == [task.id]


async def test_the_goals_of_all_clients_are_listed() -> None:
    async with robot_and_talk() as (robot, talk):
        client = ActionClient(robot.drive, DRIVE)
        with pytest.raises(Exception, match="wall"):
            await client.call(Drive(13))
        goal = await client.send_goal(Drive(100))
        listed = await talk.client.list_tasks(ListTasksRequest())
        assert sorted(map(state_of, listed.tasks)) == ["FAILED", "WORKING"]
        failed = await talk.client.list_tasks(
            ListTasksRequest(status=TaskState.TASK_STATE_FAILED, page_size=1)
        )
        assert [text_of(one) for one in failed.tasks] == ["there is a wall"]
        robot.go(100)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(goal.outcome)  # or the executor waits until its feedback is read
            updates = [told(one) async for one in talk.subscribe(str(goal.goal_id))]
        assert updates[-2:] == ["result {'at': 100.0}", "COMPLETED"]


async def test_a_goal_of_others_can_be_followed_and_canceled_only_if_nobody_is_asked() -> None:
    robot = Robot()
    async with serve((robot.drive, robot.say), robot.here):
        goal = await ActionClient(robot.drive, DRIVE).send_goal(Drive(100))
        task_id = str(goal.goal_id)
        for unasked in ([], ["*"]):
            transport = A2aHttpTransport(port=0, token=TOKEN, unasked=unasked)
            async with serve(robot.drive, transport) as (url,), talking(url) as talk:
                if unasked:
                    assert state_of(await talk.cancel(task_id)) == "CANCELED"
                    break
                with pytest.raises(TaskNotCancelableError, match="a user would have to agree"):
                    await talk.cancel(task_id)


async def test_a_read_only_server_sends_and_cancels_nothing() -> None:
    async with robot_and_talk(read_only=True) as (robot, talk):
        assert "nothing is sent or canceled" in talk.card.description
        with pytest.raises(UnsupportedOperationError, match="read-only"):
            await talk.send({"meters": 3}, skill="arm-drive")
        goal = await ActionClient(robot.drive, DRIVE).send_goal(Drive(100))
        with pytest.raises(TaskNotCancelableError, match="read-only"):
            await talk.cancel(str(goal.goal_id))
        robot.go(100)


async def test_a_task_that_is_unknown_or_takes_no_message_is_an_error() -> None:
    async with robot_and_talk() as (robot, talk):
        with pytest.raises(TaskNotFoundError, match="32 hexadecimal digits"):
            await talk.get("mine")
        with pytest.raises(TaskNotFoundError, match="never accepted"):
            await talk.get(str(GoalID.random()))
        running = await talk.send({"meters": 100}, skill="arm-drive", at_once=True)
        with pytest.raises(UnsupportedOperationError, match="takes no messages while it runs"):
            await talk.send(text="faster", task=running.id)
        robot.go(100)
        ended = await talk.send(text="hallo", skill="say")
        with pytest.raises(UnsupportedOperationError, match="the task has ended: send a message"):
            await talk.send(text="again", task=ended.id)


async def test_there_are_no_push_notifications_and_the_extended_card_is_the_whole_one() -> None:
    async with robot_and_talk() as (_, talk):
        client = talk.client
        for ask in (
            client.create_task_push_notification_config(
                TaskPushNotificationConfig(task_id="a", url="https://there.example")
            ),
            client.get_task_push_notification_config(
                GetTaskPushNotificationConfigRequest(task_id="a", id="b")
            ),
            client.list_task_push_notification_configs(
                ListTaskPushNotificationConfigsRequest(task_id="a")
            ),
            client.delete_task_push_notification_config(
                DeleteTaskPushNotificationConfigRequest(task_id="a", id="b")
            ),
        ):
            with pytest.raises(PushNotificationNotSupportedError):
                await ask
        card = await talk.client.get_extended_agent_card(GetExtendedAgentCardRequest())
        assert card.skills == talk.card.skills
