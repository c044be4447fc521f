"""The parameters of a node, and of other nodes: read, set, listed and watched."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Mapping
from typing import Any, Final, Protocol, TypeVar

from fibaction.border.abc import Notifier
from fibaction_transports.ros2.messaging.topics import Subscription
from fibaction_transports.ros2.node.own_parameters import (
    DeclaredParameter,
    ParameterValue,
    value_of,
    written,
)
from fibaction_transports.ros2.node.ros_node import RosNode

_EVENTS: Final = "/parameter_events"
_EVENT: Final = "rcl_interfaces/msg/ParameterEvent"

ValueT = TypeVar("ValueT", bound=ParameterValue)


class CallingNode(Protocol):
    """The node that asks: see `Node`."""

    def full_name(self, name: str) -> str: ...

    def subscribe(self, topic: str, type_: str, *, depth: int) -> Subscription[Any]: ...

    async def call(
        self, service: str, type_: str, request: Any, *, timeout: float | None
    ) -> Any: ...


class RemoteParameters:
    """The parameters of a node, by its full name.

    Each method waits for the node, and raises what `Node.call` raises.
    """

    def __init__(self, node: CallingNode, of: str, timeout: float | None) -> None:
        self._node = node
        self._of = node.full_name(of)
        self._timeout = timeout

    async def _call(self, service: str, request: dict[str, Any]) -> Any:
        words = "".join(part.capitalize() for part in service.split("_"))
        type_ = f"rcl_interfaces/srv/{words}"
        return await self._node.call(f"{self._of}/{service}", type_, request, timeout=self._timeout)

    async def list(self) -> list[str]:
        """Return the names of all parameters."""
        answer = await self._call("list_parameters", {})
        return [str(name) for name in answer.result.names]

    async def get(self, *names: str) -> dict[str, ParameterValue]:
        """Return parameters by their names; all without a name. Those that the node does not have
        are None.
        """
        wanted = list(names) or await self.list()
        answer = await self._call("get_parameters", {"names": wanted})
        # rclcpp leaves all values out if one of the parameters is not declared.
        values = [*map(value_of, answer.values), *[None] * (len(wanted) - len(answer.values))]
        return dict(zip(wanted, values, strict=False))

    async def set(self, values: Mapping[str, ParameterValue]) -> None:
        """Set parameters, all of them or none.

        Raises:
            TypeError: A value is of a type that parameters cannot have.
            ValueError: The node refuses it; the text has its reason.
        """
        parameters = [{"name": name, "value": written(one)} for name, one in values.items()]
        answer = await self._call("set_parameters_atomically", {"parameters": parameters})
        if not answer.result.successful:
            raise ValueError(f"{self._of} refuses {dict(values)}: {answer.result.reason}")

    async def watch(self) -> AsyncGenerator[dict[str, ParameterValue], None]:
        """Yield the parameters that change, at each change; those that are removed are None."""
        events = self._node.subscribe(_EVENTS, _EVENT, depth=1000)
        try:
            while True:
                event = await events.next()
                if event.node != self._of:
                    continue
                changed = [*event.new_parameters, *event.changed_parameters]
                found = {one.name: value_of(one.value) for one in changed}
                yield found | {one.name: None for one in event.deleted_parameters}
        finally:
            events.close()


class OwnParameters:
    """The parameters of the node itself, which other nodes and `ros2 param` read and set."""

    def __init__(self, ros: RosNode) -> None:
        self._ros = ros
        self._store = ros.parameters

    def declare(
        self,
        name: str,
        default: ValueT,
        *,
        description: str = "",
        low: float | None = None,
        high: float | None = None,
        is_read_only: bool = False,
        check: Callable[[ValueT], object] | None = None,
    ) -> ValueT:
        """Add a parameter of the type of its default, and return its value: that of the arguments
        of the node and its files of parameters, else the default.

        A number is from `low` to `high`. `check` is called with each new value, and refuses it with
        a `ValueError`, whose text others are told. A node of your own over `ros2://` calls it in
        the thread of its executor.

        Raises:
            ValueError: There is one of this name, or its first value is refused.
            TypeError: The default is of a type that parameters cannot have.
        """
        self._ros.raise_if_lost()
        self._store.declare(
            DeclaredParameter(
                name=name,
                default=default,
                description=description,
                low=low,
                high=high,
                is_read_only=is_read_only,
                check=check,
            )
        )
        value: ValueT = self[name]
        return value

    def __getitem__(self, name: str) -> Any:
        """Return the value of a parameter.

        Raises:
            KeyError: There is none of this name.
        """
        value = self._store.value(name)
        if value is None:
            raise KeyError(name)
        return value

    async def list(self) -> list[str]:
        """Return the names of all parameters."""
        return [*self._store.names()]

    async def get(self, *names: str) -> dict[str, ParameterValue]:
        """Return parameters by their names; all without a name. Those that the node does not have
        are None.
        """
        return {name: self._store.value(name) for name in names or self._store.names()}

    async def set(self, values: Mapping[str, ParameterValue]) -> None:
        """Set parameters, all of them or none.

        Raises:
            TypeError: A value is of a type that parameters cannot have.
            ValueError: A value is refused; the text has the reason.
            ConnectionLost: The node was closed.
        """
        self._ros.raise_if_lost()
        self._store.set_values(values)

    async def watch(self) -> AsyncGenerator[dict[str, ParameterValue], None]:
        """Yield the parameters that are set, by others and by the node itself. For a slow reader,
        the changes of one parameter are one.

        Raises:
            ConnectionLost: The node was closed.
        """
        changed: dict[str, ParameterValue] = {}
        news = Notifier()

        def note(values: Mapping[str, ParameterValue]) -> None:
            changed.update(values)
            news.notify()

        ends = self._store.on_change(note), self._ros.on_loss(lambda error: news.notify())
        try:
            while True:
                while not changed:
                    self._ros.raise_if_lost()
                    await news.wait()
                found = dict(changed)
                changed.clear()
                yield found
        finally:
            for end in ends:
                end()
