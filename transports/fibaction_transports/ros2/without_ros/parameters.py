"""The parameters of a node without ROS, and their services, for `ros2 param`.

A node has one parameter, as nodes of rclpy do: `use_sim_time`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.without_ros.answers import provide
from fibaction_transports.ros2.without_ros.messages import parameter_messages as messages
from fibaction_transports.ros2.without_ros.messages.node_messages import Parameter, ParameterValue

USE_SIM_TIME: Final = "use_sim_time"
_NOT_SET, _BOOL = 0, 1


class NodeParameters:
    """The parameters of a node, and the answers to questions about them."""

    def __init__(self, use_simulated_time: Callable[[bool], None]) -> None:
        """`use_simulated_time` is called with each value of `use_sim_time` that is set."""
        self._use = use_simulated_time
        self._value = ParameterValue(_BOOL, bool_value=False)

    def serve(self, ros: RosNode, node: str) -> None:
        """Answer requests to the services of a node, by its full name.

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
            provide(ros, f"{node}/{name}", service_type, answer)

    def set_use_sim_time(self, value: bool) -> None:
        """Set the parameter."""
        self._value = ParameterValue(_BOOL, bool_value=value)
        self._use(value)

    def _of(self, name: str) -> ParameterValue:
        return self._value if name == USE_SIM_TIME else ParameterValue(_NOT_SET)

    def _get(self, request: messages.NamesRequest) -> messages.ValuesResponse:
        return messages.ValuesResponse([self._of(name) for name in request.names])

    def _types(self, request: messages.NamesRequest) -> messages.TypesResponse:
        return messages.TypesResponse(bytes(self._of(name).type for name in request.names))

    def _describe(self, request: messages.NamesRequest) -> messages.DescriptorsResponse:
        return messages.DescriptorsResponse(
            [messages.ParameterDescriptor(name, self._of(name).type) for name in request.names]
        )

    def _list(self, request: messages.ListRequest) -> messages.ListResponse:
        is_wanted = not request.prefixes or USE_SIM_TIME in request.prefixes
        names = [USE_SIM_TIME] if is_wanted else []
        return messages.ListResponse(messages.ListParametersResult(names))

    def _set_each(self, request: messages.SetRequest) -> messages.SetResponse:
        return messages.SetResponse([self._set([one]) for one in request.parameters])

    def _set_atomically(self, request: messages.SetRequest) -> messages.SetAtomicallyResponse:
        return messages.SetAtomicallyResponse(self._set(request.parameters))

    def _set(self, parameters: Iterable[Parameter]) -> messages.SetParametersResult:
        parameters = list(parameters)
        for one in parameters:
            if one.name != USE_SIM_TIME:
                return messages.SetParametersResult(
                    reason=f"there is no parameter {one.name!r}, only {USE_SIM_TIME!r}"
                )
            if one.value.type != _BOOL:
                return messages.SetParametersResult(reason=f"{USE_SIM_TIME!r} is a bool")
        for one in parameters:
            self.set_use_sim_time(one.value.bool_value)
        return messages.SetParametersResult(successful=True)
