"""The types of actions, topics and services from interface files, which need no ROS."""

from __future__ import annotations

import os
import sys
from collections import OrderedDict
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from fibaction.interfaces import ActionFile, InterfaceError, read_action
from fibaction.interfaces.files import (
    InterfaceMessage,
    ServiceFile,
    inside_out,
    known_action,
    read_message,
    read_service,
)
from fibaction.interfaces.packages import SearchPath, ros_folders
from fibaction.interfaces.structs import structs_of
from fibaction.words.errors import TransportError
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import STRUCTS
from fibaction_transports.ros2.convert.conversion import (
    RosAction,
    check_action_type,
    is_action_type,
)
from fibaction_transports.ros2.node.ros_node import (
    CalledType,
    RosTypes,
    TopicType,
    TypeVersion,
)
from fibaction_transports.ros2.without_ros.messages.action_types import (
    PartlyKnownAction,
    action_of,
    message_kind,
    unknown_action,
)
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType
from fibaction_transports.ros2.without_ros.messages.node_messages import (
    NODE_STRUCTS,
    PARAMETER,
    PARAMETER_EVENT,
    PARAMETER_SERVICES,
)


def topic_type_of(message: InterfaceMessage) -> TopicType:
    """Return the type of a topic whose messages have this definition."""
    structs = structs_of(inside_out(message))
    return TopicType(_type_of(message, structs), message_kind(message, structs))


def called_type_of(file: ServiceFile) -> CalledType:
    """Return the type of a service with this definition."""
    structs = structs_of(inside_out(file.request, file.response))
    service = ServiceType(_type_of(file.request, structs), _type_of(file.response, structs))
    request, response = (message_kind(part, structs) for part in file)
    return CalledType(service, request, response)


@cache
def known_topic_types() -> dict[str, TopicType]:
    """Return the types of topics that every node has, which need no files."""
    kind = message_kind(PARAMETER_EVENT.definition, NODE_STRUCTS)
    return {PARAMETER_EVENT.name: TopicType(PARAMETER_EVENT, kind)}


@cache
def known_called_types() -> dict[str, CalledType]:
    """Return the types of services that every node has, which need no files."""
    return {
        one.name: CalledType(
            one,
            message_kind(one.Request.definition, NODE_STRUCTS),
            message_kind(one.Response.definition, NODE_STRUCTS),
        )
        for one in PARAMETER_SERVICES
    }


def _type_of(message: InterfaceMessage, structs: Mapping[str, type[msgspec.Struct]]) -> MessageType:
    codec = CdrCodec(message, structs, as_arrays=True)
    return MessageType(message, codec, structs[message.class_name])


FOLDERS: Final = "FIBACTION_SEARCH"
"""The variable of the environment with folders of packages, separated as in PATH."""
MOST_VERSIONS: Final = 100
"""Files of one type that are read to find the version that a server has."""


class InterfaceFiles:
    """The files in some folders, in those of the environment, beside the program, and in ROS."""

    def __init__(self, folders: Sequence[str | os.PathLike[str]]) -> None:
        """`folders` are searched first."""
        given = filter(None, os.environ.get(FOLDERS, "").split(os.pathsep))
        self._folders = [*map(Path, folders), *map(Path, given)]

    def folders(self) -> list[Path]:
        """Return the folders that are searched now."""
        return [*self._folders, *_program_folders(), *ros_folders()]

    def search_path(self) -> SearchPath:
        """Return the folders as those in which messages and services are searched for."""
        return SearchPath(_program_folders(), self._folders, ros_folders())

    def path(self, type_name: str) -> Path | None:
        """Return the file of a type that is found first.

        Beside the program, it may lie by itself, or in a folder with packages.
        """
        package, _, name = type_name.split("/")
        beside = (
            path
            for folder in _program_folders()
            for pattern in (f"{name}.action", f"*/{package}/action/{name}.action")
            for path in sorted(folder.glob(pattern))
        )
        paths = (folder / f"{type_name}.action" for folder in self.folders())
        return next((path for path in chain(paths, beside) if path.is_file()), None)

    def first(self, type_name: str) -> ActionFile | None:
        """Return the definition of a type that this program has loaded, or that is found first.

        Raises:
            TransportError: It cannot be used.
        """
        try:
            known = known_action(type_name)
            path = self.path(type_name)
            return known if known is not None or path is None else self._read(path, type_name)
        except (InterfaceError, OSError) as exc:
            raise TransportError(f"{type_name} cannot be used: {exc}") from exc

    def versions(self, type_name: str) -> Iterator[ActionFile]:
        """Yield all definitions of a type. Their hashes tell which is that of a server.

        A file need not lie in `package/action/`: it may lie in a folder by itself, and a folder may
        have several trees of packages, such as those of several releases.
        """
        try:
            known = known_action(type_name)
        except InterfaceError:
            known = None
        if known is not None:
            yield known
        package, _, name = type_name.split("/")
        folders = self.folders()
        patterns = (f"{package}/action", "action", ".", f"*/{package}/action")
        found = (
            path
            for folder in folders
            for pattern in patterns
            for path in sorted(folder.glob(f"{pattern}/{name}.action"))
        )
        for _, path in zip(range(MOST_VERSIONS), found, strict=False):
            try:
                yield self._read(path, type_name)
            except (InterfaceError, OSError):
                continue  # it is not the first one: no one has asked for it

    def _read(self, path: Path, type_name: str) -> ActionFile:
        return read_action(path, type_name=type_name, search=self.folders())

    def advice(self, type_name: str) -> str:
        """Return what makes a type known that is not found."""
        searched = ", ".join(map(str, self.folders())) or "no folder"
        return (
            f"put {type_name}.action beside your program, or into a folder, and name that folder"
            f" with search=FOLDER or in {FOLDERS} (searched: {searched}), or import a module that"
            " `fibaction -u ros2:// gen --from-robot` has written where ROS has this type"
        )


def _program_folders() -> list[Path]:
    """Return the folder of the program, from which Python imports first, and the current one."""
    return list(dict.fromkeys(map(Path, [*sys.path[:1], ""])))


@contextmanager
def _advised(type_name: str, ending: str) -> Generator[None, None, None]:
    """Raise an error in a file as one that says what makes the type known."""
    try:
        yield
    except (InterfaceError, OSError) as exc:
        raise TransportError(
            f"{type_name} cannot be used: {exc}; if it has no file here, put its .{ending} file"
            f" beside your program, or into a folder that search=FOLDER or {FOLDERS} names"
        ) from exc


MOST_LEARNED: Final = 1_000
"""Types that are kept as other nodes describe them."""
MOST_MISSED: Final = 1_000
"""Versions of types that are remembered because no file has them."""


class ServerVersion(NamedTuple):
    """The hashes that the servers of an action announce; empty if they announce none."""

    goal: frozenset[str]
    """Those of the requests that send goals, or of their service; `result` and `feedback`
    likewise."""
    result: frozenset[str]
    feedback: frozenset[str]

    def is_of(self, action: RosAction) -> bool:
        """Return whether an action has these hashes, as far as they are announced."""
        goals, results = action.impl.SendGoalService, action.impl.GetResultService
        ours = (goals.Request, goals), (results.Response, results), (action.impl.FeedbackMessage,)
        return all(
            not theirs or any(one.type_hash in theirs for one in types)
            for types, theirs in zip(ours, self, strict=True)
        )


class _Definition(NamedTuple):
    """A type of actions, and the file that defines it."""

    file: ActionFile
    action: RosAction
    type_hash: str = ""
    """The hash by which another node was asked for it."""


class FileTypes(RosTypes):
    """The types whose interface files are found, or were loaded by this program."""

    def __init__(self, folders: Sequence[str | os.PathLike[str]] = ()) -> None:
        """`folders` are searched first, then those of the environment and of ROS."""
        self._files = InterfaceFiles(folders)
        self._found: dict[str, _Definition] = {}
        self._learned: OrderedDict[str, _Definition] = OrderedDict()
        """The actions that other nodes have described."""
        self._unknown: dict[str, RosAction] = {}
        self._missed: set[tuple[str, ServerVersion]] = set()
        self._topics: dict[str, TopicType] = dict(known_topic_types())
        self._services: dict[str, CalledType] = dict(known_called_types())
        self.GoalInfo = STRUCTS["action_msgs/msg/GoalInfo"]
        self.Parameter = PARAMETER

    def find(self, type_name: str, action: str = "") -> RosAction:
        return self._definition(type_name, action).action

    def can_serve(self, action: RosAction) -> bool:
        messages = action.impl.FeedbackMessage, action.impl.SendGoalService.Request
        return all(isinstance(one, MessageType) and one.is_known for one in messages)

    def find_to_follow(self, type_name: str, action: str = "") -> RosAction:
        check_action_type(type_name, action)
        try:
            return self.find(type_name)
        except TransportError as exc:
            # The same object each time, so that its clients are, too.
            if type_name not in self._unknown:
                if len(self._unknown) == MOST_LEARNED:
                    self._unknown.clear()
                self._unknown[type_name] = unknown_action(type_name, str(exc))
            return self._unknown[type_name]

    def topic_type(self, type_name: str) -> TopicType:
        if type_name not in self._topics:
            with _advised(type_name, "msg"):
                message = read_message(type_name, self._files.search_path())
            self._topics[type_name] = topic_type_of(message)
        return self._topics[type_name]

    def has_topic_type(self, type_name: str) -> bool:
        """Return whether a type of messages has a file, or was learned."""
        try:
            self.topic_type(type_name)
        except TransportError:
            return False
        return True

    def learn_topic_type(self, message: InterfaceMessage) -> None:
        """Take a type of messages as another node describes it."""
        if len(self._topics) >= MOST_LEARNED:
            self._topics = dict(known_topic_types())
        self._topics[message.type_name] = topic_type_of(message)

    def called_type(self, type_name: str) -> CalledType:
        if type_name not in self._services:
            with _advised(type_name, "srv"):
                file = read_service(type_name, self._files.search_path())
            self._services[type_name] = called_type_of(file)
        return self._services[type_name]

    def texts(self, type_name: str) -> dict[str, str]:
        found = self._definition(type_name)
        if isinstance(found.action, PartlyKnownAction):
            raise TransportError(found.action.problem)
        return found.file.texts()

    def _definition(self, type_name: str, action: str = "") -> _Definition:
        if type_name not in self._found:
            check_action_type(type_name, action)
            file = self._files.first(type_name)
            if file is None and type_name in self._learned:
                return self._learned[type_name]
            if file is None:
                raise TransportError(
                    f"{type_name} is not known here: {self._files.advice(type_name)}"
                )
            self._found[type_name] = _Definition(file, action_of(file))
        return self._found[type_name]

    def choose(self, type_name: str, version: ServerVersion) -> None:
        """Take the version of a type that a server has, if a file has it."""
        key = type_name, version
        if not any(version) or key in self._missed or not is_action_type(type_name):
            return
        if type_name in self._found and version.is_of(self._found[type_name].action):
            return
        for file in self._files.versions(type_name):
            definition = _Definition(file, action_of(file))
            if version.is_of(definition.action):
                self._found[type_name] = definition
                return
        if len(self._missed) == MOST_MISSED:
            self._missed.clear()
        self._missed.add(key)

    def has_file(self, type_name: str) -> bool:
        """Return whether a type needs not be learned: it has a file, or cannot have one."""
        try:
            self.find(type_name)
        except TransportError:
            return not is_action_type(type_name) or self._files.path(type_name) is not None
        return type_name in self._found

    def has_learned(self, type_name: str, type_hash: str) -> bool:
        """Return whether another node has described a type by this hash."""
        return type_name in self._learned and self._learned[type_name].type_hash == type_hash

    def learn(self, file: ActionFile, type_hash: str, *, is_whole: bool) -> None:
        """Take a type as another node describes it. Without `is_whole`, its goal and its result
        are not known.
        """
        name, problem = file.type_name, ""
        if not is_whole:
            advice = self._files.advice(name)
            problem = f"the goal and the result of {name} are not known here: {advice}"
        self._learned[name] = _Definition(file, action_of(file, problem), type_hash)
        if len(self._learned) > MOST_LEARNED:
            self._learned.popitem(last=False)

    def version(
        self, message_type: MessageType, service_type: ServiceType | None = None
    ) -> TypeVersion | None:
        if not message_type.is_known or (service_type is not None and not service_type.is_known):
            return None
        service = "" if service_type is None else service_type.type_hash
        return TypeVersion(message_type.name, message_type.type_hash, service)

    def uuid(self, goal_id: bytes) -> bytes:
        return bytes(goal_id)

    def decode(self, message: bytes, message_type: MessageType) -> Any:
        return message_type.codec.decode(message)
