"""The values that clients and servers exchange about goals, apart from the payloads.

They are plain values, independent of transports.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextvars import ContextVar
from functools import lru_cache
from hashlib import blake2b
from typing import Any, Generic, TypeVar, cast

import msgspec
from msgspec.structs import replace

from fibaction._runtime.text import excerpt
from fibaction.words.action_error import ActionError
from fibaction.words.statuses import GoalStatus, NamedNumber

T = TypeVar("T")

WHY_UNKNOWN = "it was never accepted, its result has expired, or the server was restarted"
"""A server that does not know a goal cannot tell which of these it was."""
ID_IN_USE = "its ID is in use by another goal"
"""The reason for which a goal is rejected whose ID was sent before with another payload."""

DIGEST_SIZE = 16
"""Bytes of a digest: enough that two payloads never have the same digest by chance."""


_ID_TEXT = "^[0-9a-fA-F]{8}-?([0-9a-fA-F]{4}-?){3}[0-9a-fA-F]{12}$"
"""The pattern of the text of an ID in the schemas of pydantic."""


class GoalID(bytes):
    """The 16 bytes that name one goal forever, made by the client.

    All zeros is reserved: in a cancel it means "any goal" (`action_msgs/srv/CancelGoal`). For an ID
    that is used twice, see `fibaction.server.registry.registry`.

    For example:

        goal_id = GoalID.random()
        assert GoalID.parse(str(goal_id)) == goal_id
    """

    __slots__ = ()

    def __new__(cls, value: bytes) -> GoalID:
        """Make an ID from 16 bytes.

        Raises:
            ValueError: The length is not 16 bytes.
        """
        if len(value) != 16:
            raise ValueError(f"a goal ID has 16 bytes, not {len(value)}")
        return super().__new__(cls, value)

    @classmethod
    def random(cls) -> GoalID:
        """Return a new, unique ID of 16 random bytes."""
        return super().__new__(cls, os.urandom(16))

    @classmethod
    def parse(cls, text: str) -> GoalID:
        """Make an ID from text: 32 hexadecimal digits, as `str()` returns them, or with the dashes
        of a UUID.

        Raises:
            ValueError: The text is not such an ID.
        """
        try:
            return cls(bytes.fromhex(text.replace("-", "")))
        except ValueError:
            raise ValueError(f"a goal ID has 32 hexadecimal digits, not {text!r}") from None

    @classmethod
    def of(cls, given: object) -> GoalID:
        """Return an ID that is given as itself or as text.

        Raises:
            TypeError: It is neither.
            ValueError: The text is not an ID.
        """
        if isinstance(given, GoalID):
            return given
        if isinstance(given, str):
            try:
                return cls.parse(given)
            except ValueError as exc:
                hint = "goal.goal_id is one, and client.goals() lists those of the server"
                raise ValueError(f"{exc}: {hint}") from None
        raise TypeError(f"goal_id must be a GoalID, or the text of one, not {given!r}")

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, _handler: Any) -> Any:
        """Let pydantic, and FastAPI, read an ID from its text, and dump it as text."""
        from pydantic_core import core_schema  # only called by pydantic

        text = core_schema.no_info_after_validator_function(
            cls.parse, core_schema.str_schema(pattern=_ID_TEXT)
        )
        return core_schema.json_or_python_schema(
            json_schema=text,
            python_schema=core_schema.union_schema([core_schema.is_instance_schema(cls), text]),
            serialization=core_schema.to_string_ser_schema(when_used="always"),
        )

    def __str__(self) -> str:
        return self.hex()

    def __repr__(self) -> str:
        return f"GoalID.parse('{self.hex()}')"


NO_GOAL = GoalID(bytes(16))
"""The reserved ID of all zeros; in a cancel it means "any goal"."""


def child_id(parent: GoalID, action: str, step: str) -> GoalID:
    """Return the ID of the goal of an action that the executor of a parent sends as a step.

    It is the UUID of version 5 in the namespace of the parent, of the action and the step with a
    line feed between them; so it is the same in every attempt at the parent, and in every process.
    """
    from uuid import UUID, uuid5  # here, since most programs send no children

    return GoalID(uuid5(UUID(bytes=bytes(parent)), f"{action}\n{step}").bytes)


def digest_of(payload: bytes) -> bytes:
    """Return a digest of a goal, which tells a retry from another goal with the same ID.

    It is the same in every process, so it can be stored, and it does not keep the payload alive.
    """
    return blake2b(payload, digest_size=DIGEST_SIZE).digest()


class Sender(msgspec.Struct, frozen=True):
    """The client that sends a goal, as the transport identifies it.

    `str(sender)` is a text for people, for example `robot7 at 127.0.0.1:51234`; it is empty if
    nothing is known.

    For example:

        def on_goal(goal: Drive, sender: Sender) -> None:
            if sender.name != "dispatcher":
                raise GoalRejected("only the dispatcher drives")
    """

    name: str = ""
    """The name that belongs to the client's token; empty if the server asks for no tokens."""
    owner: bytes = b""
    """A digest that is the same on each connection of that client, and of no other client; empty if
    the transport cannot recognise its clients."""
    address: str = ""
    """The address of the client, for example `127.0.0.1:51234`; empty if it has none."""

    def __str__(self) -> str:
        return _sender_text(self.name, self.address)


@lru_cache(maxsize=1000)  # it is in each line of a list of goals
def _sender_text(name: str, address: str) -> str:
    name = excerpt(name)
    return f"{name} at {address}" if name and address else name or address


class WorkerInfo(msgspec.Struct, frozen=True):
    """One line of the list of workers of a fleet."""

    name: str
    actions: tuple[str, ...]
    """The names of the actions that it serves."""
    since: int
    """The time at which it joined the fleet: nanoseconds since 1970."""
    goals: int = 0
    """The number of its active goals, some seconds ago at most."""
    has_room: bool = True
    """True if it takes new goals of one of its actions, to run or to wait."""
    unreadable: dict[str, int] = {}
    """The number of goals that no worker has and that this one cannot read, by the names of their
    actions, as it has last counted; without the actions that have none."""
    version: str = ""
    """Its version of fibaction; empty if it does not tell it."""


UNKNOWN_SENDER = Sender()
"""A client that the transport cannot identify."""


class Parent(msgspec.Struct, frozen=True, gc=False):
    """The goal whose executor has sent another one, its child: see `GoalHandle.step`."""

    goal_id: GoalID
    step: str = ""
    """The name of the step that the child is; empty if it is not known."""


class GoalInfo(msgspec.Struct, frozen=True, gc=False):
    """One line of a server's list of goals."""

    goal_id: GoalID
    stamp: int
    """The time of the acceptance: nanoseconds since 1970, different for each goal of a server."""
    status: GoalStatus
    """The goal's status; UNKNOWN if the server has forgotten the goal."""
    feedback_count: int = 0
    """The number of feedback messages of the attempt so far; 0 also if the transport does not carry
    it."""
    client: str = ""
    """The client that sent the goal, for people to read: its `Sender` as text; empty if it is
    unknown."""
    place: int = 0
    """Place among the goals that wait, from 1: the next to start; 0 if the goal does not wait, or
    if the transport does not carry it. `ActionClient.goals` tells it; an event does not, since the
    places of all goals change with each start."""
    queue_length: int = 0
    """The number of goals that wait in the same queue; 0 with a place of 0."""
    attempt: int = 1
    """The attempt at the goal, from 1: a server that keeps its goals in a store may run a goal
    again after a restart. 1 also if the transport does not carry it."""
    parent: Parent | None = None
    """The goal whose executor has sent this one, as its client says; None if there is none, or if
    the transport does not carry it."""
    has_worker: bool = True
    """False if the goal is active, and no living worker of its fleet has it. `ActionClient.goals`
    tells it; an event does not."""
    began_at: int | None = None
    """The time at which its first attempt began: nanoseconds since 1970, by the server's clock;
    None if it has not begun, or if the transport does not carry it, as ROS."""
    ended_at: int | None = None
    """The time of the end; None if the goal is active, or if the transport does not carry it."""
    reason: str = ""
    """The reason of an abort or a cancel, or why an active goal is a suspect, and runs alone; cut
    to 200 characters; empty if there is none, or if the transport does not carry it."""
    result: Any = None
    """The result of a goal that has ended; None unless `ActionClient.goals(results=True)` has asked
    for it."""
    labels: dict[str, str] = {}
    """The labels that its client has given it, to find it again; empty if there are none, or if the
    transport does not carry them."""
    worker: str = ""
    """The name of the worker of a fleet that has the goal, or had it at its end; empty if there is
    no fleet, if no worker has it, or if the transport does not carry it."""

    def __hash__(self) -> int:  # the labels and the result may be dicts, which have none
        return hash((self.goal_id, self.stamp, self.status))

    @property
    def waited(self) -> float | None:
        """The seconds from its acceptance to the begin of its first attempt; None if that is not
        known. A step of the server's clock does not count, but between two starts of the server
        and in the history; it is never negative.
        """
        return None if self.began_at is None else max(0, self.began_at - self.stamp) / 1e9

    @property
    def ran(self) -> float | None:
        """The seconds from the begin of its first attempt to its end; None if one of them is not
        known. A step of the server's clock does not count, but between two starts of the server
        and in the history; it is never negative.
        """
        if self.began_at is None or self.ended_at is None:
            return None
        return max(0, self.ended_at - self.began_at) / 1e9


class Outcome(msgspec.Struct, Generic[T], frozen=True):
    """The end of a goal. The result is bytes between endpoints, the action's type for users.

    For example:

        outcome = await goal.outcome()
        print(outcome.status.name, outcome.result, outcome.reason)
    """

    status: GoalStatus
    """SUCCEEDED, CANCELED or ABORTED; UNKNOWN if the server knows no such goal."""
    result: T | None = None
    """The result if SUCCEEDED; a partial result or None if CANCELED or ABORTED."""
    reason: str = ""
    """The reason of the abort or the cancel, or a likely reason of UNKNOWN, as text for people."""
    ended_at: int | None = None
    """The time of the end: nanoseconds since 1970, by the server's clock; None if the transport
    does not carry it, as ROS."""

    @property
    def size(self) -> int:
        """The bytes of a result that is not decoded, and of the reason."""
        return len(cast("bytes", self.result) or b"") + len(self.reason)

    def decoded(self, decode: Callable[[T], Any]) -> Outcome[Any]:
        """Return the outcome with its result decoded by a function, which may raise its error."""
        return self if self.result is None else replace(self, result=decode(self.result))

    def readable(self, decode: Callable[[T], Any]) -> Outcome[Any]:
        """Return the outcome with its result decoded. If it cannot be, since it was stored by a
        server with another type, for example, there is none, and the reason says so.
        """
        try:
            return self.decoded(decode)
        except (ActionError, ValueError) as exc:  # as the errors of decoding are
            reason = f"{self.reason}; " if self.reason else ""
            return replace(self, result=None, reason=f"{reason}its result cannot be read: {exc}")

    @property
    def members(self) -> dict[str, Any]:
        """The outcome as members of an object of JSON."""
        return {"status": self.status.name, "result": self.result, "reason": self.reason}


UNKNOWN_OUTCOME: Outcome[Any] = Outcome(GoalStatus.UNKNOWN, reason=WHY_UNKNOWN)
"""The answer for a goal that the server never knew or has forgotten."""


class ActionPeers(msgspec.Struct, frozen=True):
    """The servers and the clients of an action, as their transport names them."""

    servers: tuple[str, ...] = ()
    clients: tuple[str, ...] = ()


class CancelCode(NamedNumber):
    """The return codes of `action_msgs/srv/CancelGoal`."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL_ID = 2
    GOAL_TERMINATED = 3


class CancelAnswer(msgspec.Struct, frozen=True):
    """The server's answer to a cancel."""

    return_code: CancelCode
    """The answer as one number; NONE also if a cancel of all goals, or by time, found none."""
    goals_canceling: tuple[GoalInfo, ...] = ()
    """The goals whose cancel was accepted, each with its status directly afterwards."""
    reason: str = ""
    """The reason of a rejected cancel; several reasons are joined with `; `."""

    @property
    def accepted(self) -> bool:
        """True if the cancel was accepted for at least one goal."""
        return bool(self.goals_canceling)

    @classmethod
    def merged(cls, answers: Iterable[CancelAnswer]) -> CancelAnswer:
        """Return one answer for one cancel that several servers have answered.

        The code is NONE if any goal is canceling. Otherwise it is the first of these that any
        server answered: REJECTED, GOAL_TERMINATED, NONE, UNKNOWN_GOAL_ID. Without answers it is
        NONE, as from a server without goals.
        """
        answers = tuple(answers)
        goals = tuple(info for answer in answers for info in answer.goals_canceling)
        reasons = "; ".join(dict.fromkeys(answer.reason for answer in answers if answer.reason))
        codes = {answer.return_code for answer in answers}
        weights = (
            CancelCode.REJECTED,
            CancelCode.GOAL_TERMINATED,
            CancelCode.NONE,
            CancelCode.UNKNOWN_GOAL_ID,
        )
        code = next((code for code in weights if code in codes), CancelCode.NONE)
        return cls(CancelCode.NONE if goals else code, goals, reasons)


class CurrentGoal:
    """The action and the ID of a goal; the ID changes if the executor takes its successor over."""

    __slots__ = ("action", "goal_id")

    def __init__(self, action: str, goal_id: GoalID) -> None:
        self.action = action
        self.goal_id = goal_id


current_goal: ContextVar[CurrentGoal | None] = ContextVar("current_goal", default=None)
"""The goal of the executor that this code is called by; None outside executors."""
