"""An action of which only the feedback is known: what a robot tells of its types without files."""

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
        self, type_name: str, impl: Any, kinds: Sequence[MessageKind], advice: str
    ) -> None:
        """`advice` says what makes the rest known."""
        super().__init__(type_name, impl, kinds)
        self.problem = f"the goal and the result of {type_name} are not known here: {advice}"
        """The reason why it takes no goals, and what to do."""

    def info(self, name: str) -> ActionInfo:
        return msgspec.structs.replace(super().info(name), goal={}, result={})

    def codecs(self, info: ActionInfo) -> RosCodecs:
        if info.goal or info.result:
            raise TransportError(self.problem)
        known = super().codecs(info)
        return RosCodecs(_UnknownGoal(self.problem), known.feedback, _UnknownResult())


class _UnknownGoal(RosCodec):
    """The codec of goals that cannot be made."""

    def __init__(self, problem: str) -> None:
        self._problem = problem

    def to_ros(self, payload: bytes | None) -> Any:
        raise TransportError(self._problem)


class _UnknownResult(RosCodec):
    """The codec of results that cannot be read: each is None."""

    def __init__(self) -> None:
        pass

    def to_ros(self, payload: bytes | None) -> Any:
        return None

    def from_ros(self, message: Any) -> bytes:
        return _NIL
