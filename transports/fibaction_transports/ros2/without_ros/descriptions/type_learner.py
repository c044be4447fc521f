"""The questions of a node about the types of actions, which other nodes answer.

Theory of operation
-------------------

An action whose interface file is not found here is looked up at the nodes that publish its
feedback, with the service `get_type_description` that nodes have since ROS 2 Jazzy. A question
needs the hash of a type, and endpoints announce the hashes of their messages only: so a node of
rclpy describes the feedback, and not the goal and the result. The nodes of this project announce
the hash of the action, too, and describe all of it. Nodes on Fast DDS 3, which ROS 2 Kilted has,
are first asked by TypeLookup for the types of all messages, which count if their hashes match.

Requests and answers announce their hashes, too. Where files define several versions of a type, they
tell which of them the server has.

The service may be off, and the answer may be wrong: each action has `ASK_TIME` seconds, and a
publisher whose answer is not as it should be is not asked again. One that does not answer is asked
again after `SILENCE` seconds: a node of rclpy answers nothing while it executes a goal.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final, Protocol

import anyio
from anyio import current_time

from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import ConnectionLost
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.node.parts import FEEDBACK, EndInfo
from fibaction_transports.ros2.node.rivals import PARTICIPANT
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.without_ros.descriptions.described_types import (
    GET_TYPE_DESCRIPTION,
    DescriptionRequest,
    DescriptionResponse,
    IndividualTypeDescription,
    UnusableDescription,
    described_action,
    described_message,
    looked_up_action,
)
from fibaction_transports.ros2.without_ros.messages.action_types import action_of
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes, ServerVersion

ASK_TIME: Final = 1.0
"""Seconds in which the type of an action is learned."""
SILENCE: Final = 5.0
"""Seconds for which a node that has not answered is not asked again."""
MOST_ACTIONS: Final = 100
"""Actions that are asked for at a time."""
MOST_SILENT: Final = 1_000
"""Publishers that are remembered because they have not answered as they should."""
_TYPES = b"types of "

logger = clean_logger("fibaction.ros2")


class ActionQuestions(Protocol):
    """The questions by which a server tells all types of an action, if its middleware has any."""

    @abstractmethod
    def can_ask(self, ends: Sequence[EndInfo]) -> bool:
        """Return whether the server of these ends can be asked. They are those that take goals,
        give results and publish feedback, in this order.
        """

    @abstractmethod
    async def look_up(
        self, ends: Sequence[EndInfo], type_name: str
    ) -> dict[str, IndividualTypeDescription]:
        """Return the types of these ends, and all that they nest, by their names. `type_name` is
        that of the action.

        Raises:
            UnusableDescription: The server does not tell them.
        """


class TypeLearner:
    """Learns the types of actions from other nodes."""

    def __init__(self, node: RosNode, types: FileTypes, questions: ActionQuestions) -> None:
        self._node = node
        self._types = types
        self._questions = questions
        self._silent: OrderedDict[bytes, float] = OrderedDict()
        """The times until which publishers are not asked, and with `_TYPES` their participants."""

    async def learn(self, actions: Sequence[tuple[str, str]]) -> None:
        """See `RosNode.learn`. If files have several versions, that of the server is used."""
        for topic, type_name in actions:
            self._types.choose(type_name, self._version(topic))
        unknown = [one for one in actions if not self._types.has_file(one[1])]
        async with anyio.create_task_group() as tasks:
            for topic, type_name in unknown[:MOST_ACTIONS]:
                tasks.start_soon(self._learn, topic, type_name)

    async def learn_topic(self, topic: str, type_name: str) -> None:
        """See `RosNode.learn_topic`."""
        if self._types.has_topic_type(type_name):
            return
        with suppress(ConnectionLost), anyio.move_on_after(ASK_TIME):
            for end in await self._publishers(topic):
                request = DescriptionRequest(type_name, end.type_hash)
                response = await ask_node(self._node, end.node, request)
                try:
                    message = described_message(response, type_name, end.type_hash)
                except UnusableDescription as exc:
                    logger.info("%s describes %s: %s", end.node, type_name, excerpt(str(exc)))
                    continue
                self._types.learn_topic_type(message)
                return

    def _version(self, topic: str) -> ServerVersion:
        ends = (*self._services(topic), self._node.publishers(topic))
        return ServerVersion(*map(_hashes, ends))

    def _services(self, topic: str) -> tuple[Sequence[EndInfo], Sequence[EndInfo]]:
        """Return the readers of goals, and the writers of results."""
        action = topic.removesuffix(FEEDBACK)
        return (
            self._node.request_readers(f"{action}/_action/send_goal"),
            self._node.answer_writers(f"{action}/_action/get_result"),
        )

    async def _learn(self, topic: str, type_name: str) -> None:
        with suppress(ConnectionLost), anyio.move_on_after(ASK_TIME):
            for end in await self._publishers(topic):
                is_whole = not end.action_hash and await self._look_up(end, topic, type_name)
                if is_whole or await self._learn_from(end, type_name):
                    return

    async def _publishers(self, topic: str) -> list[EndInfo]:
        """Return the publishers of feedback, when their nodes are known."""

        def look() -> tuple[list[EndInfo], ...]:
            now = current_time()
            ends = [
                end for end in self._node.publishers(topic) if self._silent.get(end.gid, 0.0) <= now
            ]
            return (ends,) if all(end.node for end in ends) else ()

        (found,) = await self._node.until(look)
        return found

    async def _look_up(self, end: EndInfo, topic: str, type_name: str) -> bool:
        """Learn all of an action from the types of its messages; return False if that fails."""
        messages = [
            next((one for one in ends if one.gid[PARTICIPANT] == end.gid[PARTICIPANT]), end)
            for ends in (*self._services(topic), [end])
        ]
        version = ServerVersion(*(_hashes([one]) for one in messages))
        if not (self._questions.can_ask(messages) and all(version)):
            return False
        goal_hash = messages[0].type_hash
        if self._types.has_learned(type_name, goal_hash):
            return True
        if self._silent.get(_TYPES + end.gid, 0.0) > current_time():
            return False
        self._do_not_ask(_TYPES + end.gid, SILENCE)
        with anyio.move_on_after(ASK_TIME / 2):
            try:
                found = await self._questions.look_up(messages, type_name)
                file = looked_up_action(found, type_name)
                if not version.is_of(action_of(file)):
                    raise UnusableDescription("it has another hash")
            except UnusableDescription as exc:
                self._do_not_ask(_TYPES + end.gid, math.inf)
                logger.info("%s tells of %s: %s", end.node, type_name, excerpt(str(exc)))
                return False
            self._types.learn(file, goal_hash, is_whole=True)
            self._silent.pop(_TYPES + end.gid, None)
            return True
        return False

    def _do_not_ask(self, end: bytes, seconds: float) -> None:
        self._silent[end] = current_time() + seconds
        if len(self._silent) > MOST_SILENT:
            self._silent.popitem(last=False)

    async def _learn_from(self, end: EndInfo, type_name: str) -> bool:
        questions = (
            ("action", type_name, end.action_hash),
            ("feedback", f"{type_name}_FeedbackMessage", end.type_hash),
        )
        for part, name, type_hash in questions:
            if not type_hash:
                continue
            if self._types.has_learned(type_name, type_hash):
                return True
            self._do_not_ask(end.gid, SILENCE)
            response = await ask_node(self._node, end.node, DescriptionRequest(name, type_hash))
            try:
                file = described_action(response, type_name, **{part: type_hash})
            except UnusableDescription as exc:
                self._silent[end.gid] = math.inf
                logger.info("%s describes %s: %s", end.node, name, excerpt(str(exc)))
                continue
            self._types.learn(file, type_hash, is_whole=part == "action")
            self._silent.pop(end.gid, None)
            return True
        return False


def _hashes(ends: Sequence[EndInfo]) -> frozenset[str]:
    return frozenset(end.type_hash for end in ends) - {""}


async def ask_node(asking: RosNode, node: str, request: DescriptionRequest) -> DescriptionResponse:
    """Ask a node, and wait for the answer as long as it takes."""
    response = DescriptionResponse(failure_reason="the answer cannot be read")
    is_answered = anyio.Event()

    def take(number: int, answer: Any) -> None:
        nonlocal response
        response = answer
        is_answered.set()

    caller = asking.caller(
        f"{node}/get_type_description",
        GET_TYPE_DESCRIPTION,
        qos.services(),
        take,
        lambda error: is_answered.set(),
    )
    try:
        await asking.until(caller.is_available)
        caller.send(request)
        await is_answered.wait()
    except ConnectionLost as exc:
        return DescriptionResponse(failure_reason=str(exc))
    finally:
        asking.remove(caller)
    return response
