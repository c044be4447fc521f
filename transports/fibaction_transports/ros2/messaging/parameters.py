"""The parameters of another node: read, set, listed and watched."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping
from typing import Any, Final, Protocol, TypeAlias

from fibaction_transports.ros2.messaging.subscription import Subscription

ParameterValue: TypeAlias = (
    bool | int | float | str | bytes | list[bool] | list[int] | list[float] | list[str] | None
)
"""The value of a parameter; None if it is not set."""

_EVENTS: Final = "/parameter_events"
_EVENT: Final = "rcl_interfaces/msg/ParameterEvent"
_NOT_SET, _BYTES = 0, 5
# rcl_interfaces/msg/ParameterType.msg
_FIELDS: Final = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    _BYTES: "byte_array_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}
"""The fields of a `ParameterValue`, by the numbers of types."""
_NUMBERS: Final[dict[type, int]] = {bool: 1, int: 2, float: 3, str: 4}
_ARRAYS: Final[dict[type, int]] = {bool: 6, int: 7, float: 8, str: 9}


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


def value_of(value: Any) -> ParameterValue:
    """Return the value in an `rcl_interfaces/msg/ParameterValue`."""
    field = _FIELDS.get(value.type)
    if field is None:
        return None
    found: Any = getattr(value, field)
    if value.type == _BYTES:
        return bytes(found) if isinstance(found, bytes) else b"".join(found)
    # Arrays of numbers are those of Python or of numpy.
    plain: ParameterValue = found.tolist() if hasattr(found, "tolist") else found
    return plain


def written(value: ParameterValue) -> dict[str, Any]:
    """Return a value as the fields of an `rcl_interfaces/msg/ParameterValue`.

    Raises:
        TypeError: Parameters cannot have it.
    """
    if value is None:
        return {"type": _NOT_SET}
    number = _NUMBERS.get(type(value))
    if isinstance(value, bytes):
        number = _BYTES
    elif isinstance(value, list):
        kinds = {type(one) for one in value} or {str}
        number = _ARRAYS.get(kinds.pop()) if len(kinds) == 1 else None
    if number is None:
        raise TypeError(
            f"{value!r} cannot be a parameter: these are bool, int, float, str, bytes, and lists"
            " of one of the first four"
        )
    return {"type": number, _FIELDS[number]: value}
