"""The services of a node's parameters, for `ros2 param`.

rclpy makes them, and its executor would answer their requests. But a `Spinner` does without that
executor, except for what is rclpy's own. So they are taken from the node, and their requests are
taken together with everything else.
"""

from __future__ import annotations

from typing import Any

from fibaction_transports.ros2.on_rclpy.rcl import ParameterService
from fibaction_transports.ros2.on_rclpy.waitable import Source


class ParameterRequests(Source):
    """The requests to one of the services. They are answered in the thread that spins the node."""

    kind = "service"

    def __init__(self, service: Any) -> None:
        super().__init__(service.handle, sink=lambda _: None)  # `take` does all
        self._service = service

    def take(self) -> None:
        """Answer one request. If there are more, the executor wakes again."""
        request, header = self.handle.service_take_request(self._service.srv_type.Request)
        if header is not None:
            response = self._service.callback(request, self._service.srv_type.Response())
            self._service.send_response(response, header)


def parameter_services(node: Any) -> list[ParameterRequests]:
    """Make the services of a node, and return the sources of their requests."""
    others = set(node.services)
    node._parameter_service = ParameterService(node)
    services = [one for one in node.services if one not in others]
    for service in services:
        node._services.remove(service)
    return [ParameterRequests(service) for service in services]
