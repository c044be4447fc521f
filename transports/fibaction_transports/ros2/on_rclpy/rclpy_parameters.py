"""The parameters of a node of rclpy, which serves them itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fibaction.words.errors import text_of
from fibaction_transports.ros2.node.own_parameters import (
    KINDS,
    DeclaredParameter,
    ParameterStore,
    ParameterValue,
    number_of,
    value_of,
)
from fibaction_transports.ros2.on_rclpy.rcl import ros_exceptions, ros_messages, ros_parameters


class RclpyParameters(ParameterStore):
    """The parameters of a node of rclpy."""

    def __init__(self, node: Any, later: Callable[[Any, Any], None]) -> None:
        """`later` calls a function with an argument on the event loop, from any thread."""
        super().__init__()
        self._node = node
        self._later = later
        self._declared: dict[str, DeclaredParameter] = {}
        self._begun = ""
        """The parameter that is being declared, which is not a change."""
        self._hooks = {
            node.add_on_set_parameters_callback: self._checked,
            node.add_post_set_parameters_callback: self._note,
        }

    def declare(self, parameter: DeclaredParameter) -> None:
        name, number = parameter.name, number_of(parameter.default)
        for add, hook in self._hooks.items():  # a node of the user has none without parameters
            add(hook)
        self._hooks.clear()
        descriptor = ros_messages.ParameterDescriptor(
            name=name, description=parameter.description, read_only=parameter.is_read_only
        )
        if parameter.bounds:
            low, high = parameter.bounds
            kind, made = "floating_point_range", ros_messages.FloatingPointRange
            if KINDS[number].startswith("integer"):
                kind, made = "integer_range", ros_messages.IntegerRange
            setattr(descriptor, kind, [made(from_value=low, to_value=high)])
        known = self._declared.get(name)
        self._declared[name], self._begun = parameter, name
        try:
            if parameter.default == []:
                self._declare_empty(name, descriptor)
            else:
                self._node.declare_parameter(name, _in_ros(parameter.default), descriptor)
        except Exception as exc:
            self._declared.pop(name)
            if known is not None:
                self._declared[name] = known
            raise ValueError(text_of(exc).partition(": ")[2]) from exc
        finally:
            self._begun = ""

    def _declare_empty(self, name: str, descriptor: Any) -> None:
        """Declare a list of strings; rclpy would take an empty list for bytes."""
        strings = ros_parameters.Parameter.Type.STRING_ARRAY
        given = self._node.declare_parameter(name, strings)
        if given.type_ != strings:  # the arguments of the node do not have it
            self._node.set_parameters([ros_parameters.Parameter(name, strings, [])])
        descriptor.type = strings.value
        self._node.set_descriptor(name, descriptor)

    def names(self) -> Sequence[str]:
        return [str(one) for one in self._node.list_parameters([], 0).names]

    def value(self, name: str) -> ParameterValue:
        if not self._node.has_parameter(name):
            return None
        return value_of(self._node.get_parameter(name).get_parameter_value())

    def set_values(self, values: Mapping[str, ParameterValue]) -> None:
        made = [self._made(name, value) for name, value in values.items()]
        try:
            result = self._node.set_parameters_atomically(made)
        except ros_exceptions.ParameterNotDeclaredException as exc:
            missing = next(name for name in values if not self._node.has_parameter(name))
            raise ValueError(f"there is no parameter {missing!r}") from exc
        if not result.successful:
            raise ValueError(result.reason)

    def _made(self, name: str, value: ParameterValue) -> Any:
        kind = ros_parameters.Parameter.Type(number_of(value))
        if value == []:  # of any type; rclpy would take it for bytes
            kind = self._node.get_parameter_or(name).type_
        return ros_parameters.Parameter(name, kind, _in_ros(value))

    def _checked(self, parameters: Any) -> Any:
        for one in parameters:
            declared = self._declared.get(one.name)
            value = value_of(one.get_parameter_value())
            problem = declared and value is not None and declared.checked(value)
            if problem:
                return ros_messages.SetParametersResult(successful=False, reason=problem)
        return ros_messages.SetParametersResult(successful=True)

    def _note(self, parameters: Any) -> None:
        changed = {one.name: value_of(one.get_parameter_value()) for one in parameters}
        if self._begun not in changed:
            self._later(self.tell, changed)


def _in_ros(value: ParameterValue) -> Any:
    return [bytes([one]) for one in value] if isinstance(value, bytes) else value
