"""Settings that type checkers must reject. Nobody runs this: mypy and pyright read it.

An error that is expected has an ignore beside it, and one that is not needed is an error itself.
"""

from __future__ import annotations

from typing import Any

from fibaction import Action, ActionServer, Limits, connect, serve
from fibaction_transports.tcp import TcpTransport, UnixTransport

COUNT: Action[int, int, int] = Action("count", goal=int, feedback=int, result=int)


def settings_of_a_client() -> None:
    connect("tcp://robot", COUNT, heartbeat=2, token="secret", limits=Limits(frame=2000))
    connect("ros2://", namespace="/robot", discovery_timeout=1.5)
    connect("dds://", search=["interfaces"], discovery="LOCALHOST", peers=["robot"])
    connect("tcp://robot", COUNT, hartbeat=2)  # type: ignore[call-overload]  # pyright: ignore[reportCallIssue]
    connect("tcp://robot", heartbeat="2")  # type: ignore[call-overload]  # pyright: ignore[reportArgumentType, reportCallIssue]
    connect("tcp://robot", tokens={})  # type: ignore[call-overload]  # pyright: ignore[reportCallIssue]


def settings_of_a_server(server: ActionServer[Any, Any, Any]) -> None:
    serve(server, "tcp://robot", tokens={"secret": "ann"}, orphans="cancel", insecure=True)
    serve(server, "tcp://robot", grase=1)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    serve(server, "tcp://robot", orphans="kill")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]


def settings_of_a_transport() -> None:
    TcpTransport(port=0, window=16)
    TcpTransport(hartbeat=2)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    UnixTransport("/run/robot", insecure=True)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
