"""The parameters of a node without ROS, and their services, for `ros2 param`.

Each node has `use_sim_time`, as nodes of rclpy do, and those that its user declares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from fibaction.words.extras import NeedsExtra
from fibaction.words.plain_data import is_list
from fibaction_transports.cdr.standard_messages import TimeMessage
from fibaction_transports.ros2.node.own_parameters import (
    ARRAY,
    BYTES,
    KINDS,
    DeclaredParameter,
    ParameterStore,
    kind_of,
    number_of,
    value_of,
    written,
)
from fibaction_transports.ros2.node.own_parameters import ParameterValue as Value
from fibaction_transports.ros2.node.parts import TopicPublisher
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages import node_messages as messages
from fibaction_transports.ros2.without_ros.messages.message_type import ServiceType
from fibaction_transports.ros2.without_ros.messages.node_messages import (
    PARAMETER_EVENT,
    Parameter,
    ParameterEvent,
    ParameterValue,
)
from fibaction_transports.ros2.without_ros.ros_arguments import Override

USE_SIM_TIME: Final = "use_sim_time"
_EVENTS, _EVENTS_QOS = "/parameter_events", EndQos(depth=1000)
_WORDS = {
    **dict.fromkeys(("true", "yes", "on", "y"), True),
    **dict.fromkeys(("false", "no", "off", "n"), False),
}
"""The words of rcl."""


class NodeParameters(ParameterStore):
    """The parameters of a node, and the answers to questions about them."""

    def __init__(self, ros: RosNode, overrides: Mapping[str, Override]) -> None:
        """Begin without parameters. `overrides` are the values of the arguments."""
        super().__init__()
        self._ros = ros
        self._overrides = overrides
        self._declared: dict[str, DeclaredParameter] = {}
        self._values: dict[str, Value] = {}
        self._events: TopicPublisher | None = None

    def serve(self, provide: Callable[[str, ServiceType, Callable[[Any], Any]], None]) -> None:
        """Answer requests to the services of the node, which are made by `OwnNode.provide`.

        Raises:
            TransportError: A service cannot be made.
        """
        for name, service_type, answer in (
            ("get_parameters", messages.GET_PARAMETERS, self._get),
            ("get_parameter_types", messages.GET_PARAMETER_TYPES, self._types),
            ("describe_parameters", messages.DESCRIBE_PARAMETERS, self._describe),
            ("list_parameters", messages.LIST_PARAMETERS, self._list),
            ("set_parameters", messages.SET_PARAMETERS, self._set_each),
            (
                "set_parameters_atomically",
                messages.SET_PARAMETERS_ATOMICALLY,
                self._set_atomically,
            ),
        ):
            provide(f"{self._ros.full_name}/{name}", service_type, answer)

    # The store

    def declare(self, parameter: DeclaredParameter) -> None:
        name, value = parameter.name, parameter.default
        if not name:
            raise ValueError("a parameter needs a name")
        if name in self._declared:
            raise ValueError(f"the parameter {name!r} is declared already")
        if not (number := number_of(value)):
            raise TypeError(f"the parameter {name!r} needs a default, which tells its type")
        given = self._overrides.get(name)
        if given is not None:
            value = _value_in(given, number)
        if problem := parameter.problem(value):
            raise ValueError(problem if given is None else f"{given.origin}: {problem}")
        self._declared[name], self._values[name] = parameter, value
        if name != USE_SIM_TIME:
            self._announce(ParameterEvent(new_parameters=[Parameter(name, self._of(name))]))

    def names(self) -> Sequence[str]:
        return [*self._declared]

    def value(self, name: str) -> Value:
        return self._values.get(name)

    def set_values(self, values: Mapping[str, Value]) -> None:
        for name, value in values.items():
            declared = self._declared.get(name)
            if declared is None:
                known = ", ".join(map(repr, self._declared))
                raise ValueError(f"there is no parameter {name!r}, only {known}")
            if declared.is_read_only:
                raise ValueError(f"{name!r} is read-only")
            if problem := declared.problem(value):
                raise ValueError(problem)
        self._values |= values
        changed = [Parameter(name, self._of(name)) for name in values]
        self._announce(ParameterEvent(changed_parameters=changed))
        self.tell(values)

    def _announce(self, event: ParameterEvent) -> None:
        """Tell others, from the first parameter of the user on."""
        if self._events is None and [*self._declared] != [USE_SIM_TIME]:
            self._events = self._ros.publisher(_EVENTS, PARAMETER_EVENT, _EVENTS_QOS)
        if self._events is not None:
            event.stamp = TimeMessage(*divmod(self._ros.clock.now(), 10**9))
            event.node = self._ros.full_name
            self._events.publish(event)

    # The services

    def _of(self, name: str) -> ParameterValue:
        if name not in self._declared:
            return ParameterValue()
        fields: dict[str, Any] = written(self._values[name])
        fields["type"] = number_of(self._declared[name].default)
        return ParameterValue(**fields)

    def _get(self, request: messages.NamesRequest) -> messages.ValuesResponse:
        return messages.ValuesResponse([self._of(name) for name in request.names])

    def _types(self, request: messages.NamesRequest) -> messages.TypesResponse:
        return messages.TypesResponse(bytes(self._of(name).type for name in request.names))

    def _describe(self, request: messages.NamesRequest) -> messages.DescriptorsResponse:
        return messages.DescriptorsResponse([self._described(name) for name in request.names])

    def _described(self, name: str) -> messages.ParameterDescriptor:
        one = self._declared.get(name, DeclaredParameter(name=name, default=None))
        number = number_of(one.default)
        found = messages.ParameterDescriptor(
            name, number, description=one.description, read_only=one.is_read_only
        )
        if one.bounds and KINDS[number].startswith("integer"):
            low, high = map(int, one.bounds)
            found.integer_range = [messages.IntegerRange(low, high)]
        elif one.bounds:
            found.floating_point_range = [messages.FloatingPointRange(*one.bounds)]
        return found

    def _list(self, request: messages.ListRequest) -> messages.ListResponse:
        names = [
            name
            for name in self._declared
            if any(_is_below(name, prefix, request.depth) for prefix in request.prefixes or [""])
        ]
        prefixes = {name.rpartition(".")[0] for name in names} - {""}
        return messages.ListResponse(messages.ListParametersResult(names, sorted(prefixes)))

    def _set_each(self, request: messages.SetRequest) -> messages.SetResponse:
        return messages.SetResponse([self._set([one]) for one in request.parameters])

    def _set_atomically(self, request: messages.SetRequest) -> messages.SetAtomicallyResponse:
        return messages.SetAtomicallyResponse(self._set(request.parameters))

    def _set(self, parameters: Sequence[Parameter]) -> messages.SetParametersResult:
        try:
            self.set_values({one.name: value_of(one.value) for one in parameters})
        except ValueError as exc:
            return messages.SetParametersResult(reason=str(exc))
        return messages.SetParametersResult(successful=True)


def _is_below(name: str, prefix: str, depth: int) -> bool:
    """Return whether a name is a prefix, or has at most so many levels after it, if not 0."""
    rest = name.removeprefix(f"{prefix}.") if prefix else name
    is_there = not prefix or name == prefix or rest != name
    return is_there and (not depth or rest.count(".") < depth)


def _value_in(given: Override, number: int) -> Value:
    """Return the value of an argument, as one of a type.

    Raises:
        ValueError: It is not one.
    """
    content: Any = given.value
    try:
        if number < BYTES:
            content = _scalar(content, number)
            return content  # type: ignore[no-any-return]  # of the type of the number
        if isinstance(content, str):
            with NeedsExtra("a list of parameters", "fibaction[cli]"):
                import yaml
            content = yaml.load(content, yaml.BaseLoader)
        if number > ARRAY and is_list(content):
            return [_scalar(one, number - ARRAY) for one in content]
    except (ValueError, TypeError, KeyError):
        pass
    expected = "true or false" if KINDS[number] == "bool" else kind_of(number)
    raise ValueError(f"{given.origin}: expected {expected}")


def _scalar(text: Any, number: int) -> Any:
    if not isinstance(text, str):
        raise TypeError
    if number == number_of(True):
        return _WORDS[text.lower()]
    if number == number_of(0):
        return int(text, 0)
    if number == number_of(0.0):
        return float(text)
    is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "\"'"
    return text[1:-1] if is_quoted else text
