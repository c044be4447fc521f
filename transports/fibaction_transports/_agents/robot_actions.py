"""`RobotActions`: the actions of some servers, by the names that agents have for them;
`AgentPolicy`: the rules for what an agent may do with them; and the questions to users before goals
are sent, for which the policy may ask.

Language models take letters, digits, `_` and `-`, and at most 64 of them. So `arm/pick` is
`arm-pick`, and on a server that is called `left` it is `left-arm-pick`. A name stays for as long as
its action is there. What cannot be used here, for example because its ROS type is not installed, is
left out, and the log says so once.

`OpenQuestions` are those that wait for their answers.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from hashlib import blake2b
from typing import Any, ClassVar, Generic, TypeVar

import anyio
import msgspec

from fibaction.border.abc import Connection, Notifier
from fibaction.border.gateway import SeenServer, ServerGroup
from fibaction.border.peer_text import clean_logger, excerpt, with_escapes
from fibaction.border.settings import TransportSettings
from fibaction.schema.payload import GoalCodec, JsonCodec, PayloadError, to_json
from fibaction.types.action import ActionInfo
from fibaction.words.errors import TransportError

MOST_ACTIONS = 200
"""Actions of one server that agents get; far fewer are too many for most models."""
LONGEST = 64
"""Characters of a name."""
logger = clean_logger("fibaction.agents")


class AgentPolicy(TransportSettings, frozen=True, kw_only=True):
    """The rules for what an agent may do: a language model, or a program that has one.

    By default it may send goals to all actions, and the user is asked before each goal. A client
    that cannot ask its user gets an error in place of the goal.

    A pattern is the name of an action without a slash in front, in which `*` stands for any
    characters: `arm/*`. With several servers, `left:arm/*` is for the server of that name only.

    For example:

        AgentPolicy(allow=("arm/*", "camera/look"), unasked=("camera/look",))
    """

    for_clients: ClassVar[bool] = False

    allow: Sequence[str] = ("*",)
    """Patterns of the actions that are shown to the agent; all others do not exist for it."""
    unasked: Sequence[str] = ()
    """Patterns of the actions whose goals are sent without a question to the user."""
    read_only: bool = False
    """Show the actions and their goals, and let nothing be sent or canceled."""
    patience: float = 50.0
    """Seconds after which a tool, or a message of A2A, is answered that its goal still runs. Many
    clients give up after 60 s, and that would cancel the goal of a tool."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: The patience is not a number of seconds, or a pattern is empty.
        """
        for name in ("allow", "unasked"):  # an iterator would be used up by the check
            msgspec.structs.force_setattr(self, name, tuple(getattr(self, name)))
        if not 0 < self.patience < math.inf:
            raise ValueError(
                f"patience must be finite and more than 0 seconds, not {self.patience}"
            )
        if not all((*self.allow, *self.unasked)):
            raise ValueError("a pattern is the name of an action, and cannot be empty")

    def allows(self, server: str, action: str) -> bool:
        """Return whether the agent may know the action."""
        return _matches(self.allow, server, action)

    def asks(self, server: str, action: str) -> bool:
        """Return whether the user is asked before a goal of that action."""
        return not _matches(self.unasked, server, action)


def _matches(patterns: Iterable[str], server: str, action: str) -> bool:
    name = action.lstrip("/")
    for pattern in patterns:
        wanted, colon, rest = pattern.rpartition(":")
        if colon and wanted != server:
            continue
        if fnmatchcase(name, rest.lstrip("/")):
            return True
    return False


class RobotAction:
    """One action that is served now."""

    def __init__(self, server: str, info: ActionInfo, connection: Connection, label: str):
        """Describe an action.

        Raises:
            PayloadError: The schema of its goals cannot be used.
            TransportError: It cannot be used from here.
        """
        self.server = server
        """The name of its server; empty if there is only one."""
        self.info = info
        self.connection = connection
        self.label = label
        """The name that agents have for it."""
        self.goals = GoalCodec(info.goal)
        self.endpoint = connection.endpoint(info)

    @property
    def title(self) -> str:
        """The action for people: its name, with that of its server if there are several."""
        name = excerpt(self.info.name.lstrip("/"))
        return f"{name} of {self.server}" if self.server else name


ActionT = TypeVar("ActionT", bound=RobotAction)

MakeAction = Callable[[str, ActionInfo, Connection, str], ActionT]
"""Makes one action, as `RobotAction` is made."""


class RobotActions(Generic[ActionT]):
    """The actions of a group of servers, as far as an agent may know them."""

    def __init__(
        self,
        group: ServerGroup,
        policy: AgentPolicy,
        make: MakeAction[ActionT],
        reserved: Collection[str] = (),
    ) -> None:
        """Make the actions of a group by `make`; none has a `reserved` name."""
        self.news = Notifier()
        """Notified when the list of names has changed."""
        self._make = make
        self._reserved = reserved
        self._group = group
        self._policy = policy
        self._taken: dict[str, SeenServer] = {}
        self._known: dict[str, dict[str, ActionT]] = {}
        self._left_out: set[tuple[str, str]] = set()

    @property
    def problems(self) -> dict[str, str]:
        """For each server, the reason why it cannot be reached now; empty if it can."""
        return self._group.problems

    @property
    def are_all_reached(self) -> bool:
        """True if all servers have told their actions, and can be asked now."""
        self.refresh()
        problems = self._group.problems
        return all(server in self._taken and not text for server, text in problems.items())

    @property
    def by_label(self) -> dict[str, ActionT]:
        """The actions by the names that agents have for them."""
        self.refresh()
        # In the order of the servers, whichever of them has answered first.
        known = [self._known.get(server, {}) for server in self._group.problems]
        return {one.label: one for actions in known for one in actions.values()}

    def refresh(self) -> None:
        """Take the actions that the servers have now."""
        for server, seen in self._group.servers.items():
            if seen is not self._taken.get(server):
                self._taken[server] = seen
                self._take(server, seen)

    async def follow(self) -> None:
        """Refresh the actions whenever an action comes or goes, until canceled."""
        while True:
            self.refresh()
            await self._group.news.wait()

    def _take(self, server: str, seen: SeenServer) -> None:
        """Take the actions of a server, and no others of it."""
        before, now = self._known.get(server, {}), dict[str, ActionT]()
        for info in seen.actions:
            if not self._policy.allows(server, info.name):
                continue
            if len(now) == MOST_ACTIONS:
                self._leave_out(server, info, f"only {MOST_ACTIONS} actions are shown")
                continue
            known = before.get(info.name)
            if known is None or known.info != info or known.connection is not seen.connection:
                label = known.label if known else self._new_label(server, info.name, now)
                try:
                    known = self._make(server, info, seen.connection, label)
                except (TransportError, PayloadError) as exc:
                    self._leave_out(server, info, str(exc))
                    continue
            now[info.name] = known
        self._known[server] = now
        if {name: one.info for name, one in before.items()} != {
            name: one.info for name, one in now.items()
        }:
            self.news.notify()

    def _new_label(self, server: str, action: str, now: Mapping[str, ActionT]) -> str:
        parts = (*self._known.values(), now)
        taken = {*self._reserved, *(one.label for part in parts for one in part.values())}
        return action_name(server, action, taken)

    def _leave_out(self, server: str, info: ActionInfo, reason: str) -> None:
        if (server, info.name) not in self._left_out and len(self._left_out) < MOST_ACTIONS:
            self._left_out.add((server, info.name))
            logger.warning("action %s is left out: %s", info.name, reason)


def action_name(server: str, action: str, taken: Collection[str]) -> str:
    """Return the name of an action, which is none of those that are taken.

    A name that is too long or taken ends with digits that depend on the server and the action only.
    """
    parts = [server, *action.lstrip("~").split("/")]
    name = re.sub(r"[^A-Za-z0-9_-]", "_", "-".join(part for part in parts if part))
    if name and len(name) <= LONGEST and name not in taken:
        return name
    digest = blake2b(f"{server}\n{action}".encode(errors="replace"), digest_size=4).hexdigest()
    return f"{name[: LONGEST - len(digest) - 1]}_{digest}"


QUESTION_TIMEOUT = 600.0
"""Seconds that a user has to answer a question."""
MOST_QUESTIONS = 1000
"""Questions that wait for their answers at once; the oldest of more is forgotten."""

QuestionT = TypeVar("QuestionT")
LONGEST_GOAL = 4000
"""Characters of a goal that a user is asked about. The user must see all of what is sent."""
MOST_LINES = 40
"""Lines of a goal that is shown with one field on a line."""


class OpenQuestions(Generic[QuestionT]):
    """Questions by their keys, in the order in which they were asked."""

    def __init__(self) -> None:
        self._questions: dict[str, tuple[QuestionT, float]] = {}

    def add(self, key: str, question: QuestionT) -> None:
        """Begin to wait for an answer; a question that is asked again is the newest."""
        self._questions.pop(key, None)
        while len(self._questions) >= MOST_QUESTIONS:
            del self._questions[next(iter(self._questions))]
        self._questions[key] = question, anyio.current_time() + QUESTION_TIMEOUT

    def find(self, key: str) -> QuestionT | None:
        """Return a question; None if there is none, or it was asked too long ago."""
        question, expires = self._questions.get(key, (None, 0.0))
        return question if expires > anyio.current_time() else None

    def close(self, key: str) -> None:
        """Wait for the answer no longer."""
        self._questions.pop(key, None)


class UnshownGoal(Exception):
    """A goal that cannot be shown to the user, so that it is not sent; the text says why."""


def goal_text(message: Mapping[str, Any] | Any, goals: JsonCodec) -> str:
    """Return a goal as the user is to see it: JSON, and the names of the fields that are left to
    the server, without characters that could deceive.

    Raises:
        UnshownGoal: It is too long to be shown, or cannot be.
    """
    try:
        line = to_json(message)
    except PayloadError as exc:
        raise UnshownGoal(f"The goal was not sent, because the user cannot see it: {exc}") from exc
    lines = json.dumps(json.loads(line), indent=2, ensure_ascii=False).split("\n")
    shown = [line] if len(lines) > MOST_LINES else lines
    text = _without_deceit(shown)
    if len(text) > LONGEST_GOAL:
        raise UnshownGoal(
            f"The goal was not sent: it has {len(text)} characters, and the user, who must agree to"
            f" it, can be shown {LONGEST_GOAL}. Send a shorter one."
        )
    if left_out := goals.left_out(message):
        text += "\n\n" + _without_deceit([f"The server fills in: {', '.join(left_out)}"])
    return text


def question_about(action: RobotAction, goal: Any) -> str:
    """Return the question to the user whether a goal may be sent.

    Raises:
        UnshownGoal: It cannot be shown, as for `goal_text`.
    """
    return f"Send this goal to the action {action.title}?\n\n{goal_text(goal, action.goals)}"


def _without_deceit(lines: Iterable[str]) -> str:
    return "\n".join(with_escapes(line, lambda c: json.dumps(c)[1:-1]) for line in lines)
