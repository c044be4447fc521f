"""An open node as the transport of actions uses it, for as long as a block lasts."""

from __future__ import annotations

from types import TracebackType
from typing import Any, TypeVar, cast

from fibaction_transports.ros2.node.parts import NodePart
from fibaction_transports.ros2.node.ros_node import NodeLife, RosNode

PartT = TypeVar("PartT", bound=NodePart)


class PartsOfBlock(NodeLife):
    """A view of a node that removes at the end of a block what was made through it.

    The two halves of the transport leave their parts to the end of their node, which is another
    one here, and a client ends what waits by the end of its node.
    """

    def __init__(self, ros: RosNode) -> None:
        super().__init__()
        self._ros = ros
        self._parts: list[NodePart] = []

    @property
    def is_up(self) -> bool:
        return self._ros.is_up and self.error is None

    def __enter__(self) -> RosNode:
        self._forget = self._ros.on_loss(self.fail)
        return cast("RosNode", self)

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._forget()
        for part in reversed(self._parts):
            self._ros.remove(part)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ros, name)

    def _keep(self, part: PartT) -> PartT:
        self._parts.append(part)
        return part

    def publisher(self, *given: Any, **named: Any) -> Any:
        """See `RosNode.publisher`; the others likewise."""
        return self._keep(self._ros.publisher(*given, **named))

    def subscription(self, *given: Any, **named: Any) -> Any:
        return self._keep(self._ros.subscription(*given, **named))

    def caller(self, *given: Any, **named: Any) -> Any:
        return self._keep(self._ros.caller(*given, **named))

    def provider(self, *given: Any, **named: Any) -> Any:
        return self._keep(self._ros.provider(*given, **named))

    def life_watch(self, *given: Any, **named: Any) -> Any:
        return self._keep(self._ros.life_watch(*given, **named))
