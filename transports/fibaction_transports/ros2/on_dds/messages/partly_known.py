"""Actions whose types are known in part, or not at all, because a robot tells no more of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from fibaction.types.action import ActionInfo
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.convert.conversion import RosAction, RosCodec, RosCodecs
from fibaction_transports.ros2.convert.message_types import MessageKind

_NIL = msgspec.msgpack.encode(None)


class PartlyKnownAction(RosAction):
    """An action whose goal and result are not known: its goals are followed, and none is sent."""

    def __init__(
        self,
        type_name: str,
        impl: Any,
        kinds: Sequence[MessageKind],
        problem: str,
        *,
        has_feedback: bool = True,
    ) -> None:
        """Describe it. `problem` says what is not known, and what makes it known. Without
        `has_feedback`, the feedback is not known, either.
        """
        super().__init__(type_name, impl, kinds)
        self.problem = problem
        self._has_feedback = has_feedback

    def info(self, name: str) -> ActionInfo:
        feedback = super().info(name).feedback if self._has_feedback else {}
        return ActionInfo(name, self.type_name, feedback=feedback)

    def codecs(self, info: ActionInfo) -> RosCodecs:
        if info.goal or info.result or (info.feedback and not self._has_feedback):
            raise TransportError(self.problem)
        unknown = _UnknownPart()
        feedback = super().codecs(info).feedback if self._has_feedback else unknown
        return RosCodecs(_UnknownGoal(self.problem), feedback, unknown)


class _UnknownGoal(RosCodec):
    """The codec of goals that cannot be made."""

    def __init__(self, problem: str) -> None:
        self._problem = problem

    def to_ros(self, payload: bytes | None) -> Any:
        raise TransportError(self._problem)


class _UnknownPart(RosCodec):
    """The codec of results, or of feedback, that cannot be read: each is None."""

    def __init__(self) -> None:
        pass

    def to_ros(self, payload: bytes | None) -> Any:
        return None

    def from_ros(self, message: Any) -> bytes:
        return _NIL
