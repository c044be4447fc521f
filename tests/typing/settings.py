"""Each setting of each transport, for type checkers, and settings that they must reject.

Nobody runs this: type checkers read it, and `tests/transports/test_setting_keywords.py` compares it
with the settings that there are.

An error that is expected has an ignore beside it, and one that is not needed is an error itself.
"""

from __future__ import annotations

from typing import Any

from fibaction import Action, ActionServer, Limits, Peer, Permission, blocking, call, connect, serve
from fibaction.observe.metrics import Metrics
from fibaction_transports.a2a import A2aHttpTransport
from fibaction_transports.inprocess import InProcessTransport
from fibaction_transports.keywords import (
    AgentHttpKeywords,
    AgentPolicyKeywords,
    ClientKeywords,
    DdsKeywords,
    RosbridgeKeywords,
    RosKeywords,
    WireKeywords,
    ZenohKeywords,
)
from fibaction_transports.mcp import McpHttpTransport, McpStdioTransport
from fibaction_transports.nats import NatsTransport
from fibaction_transports.ros2 import DdsTransport, Ros2Transport, ZenohTransport
from fibaction_transports.tcp import TcpTransport, TlsFiles, UnixTransport
from fibaction_transports.web import (
    HttpTransport,
    RosbridgeTransport,
    WebSocketTransport,
    WebTransport,
)

COUNT: Action[int, int, int] = Action("count", goal=int, feedback=int, result=int)
LIMITS = Limits(frame=2000)
TLS = TlsFiles(ca="a.pem")


async def authorize(peer: Peer, action: str, permission: Permission) -> bool:
    return True


CLIENT: ClientKeywords = {
    "token": "secret",
    "heartbeat": 2,
    "window": 16,
    "limits": LIMITS,
    "reconnect": False,
    "reconnect_timeout": 5,
}
WIRE: WireKeywords = {
    **CLIENT,
    "tokens": None,
    "authorize": None,
    "orphans": "keep",
    "grace": 5,
}
ROS: RosKeywords = {
    "namespace": "/robot",
    "domain_id": 7,
    "arguments": None,
    "feedback_depth": 10,
    "discovery_timeout": 1.5,
    "lease": 1,
    "reconnect": True,
    "reconnect_timeout": 5,
    "services_qos": "",
    "feedback_qos": "",
    "status_qos": "",
    "introspection": "off",
}
DDS: DdsKeywords = {
    **ROS,
    "search": ["interfaces"],
    "discovery": "LOCALHOST",
    "peers": ["robot"],
    "network": ["10.0.0.2"],
    "ip_versions": (4, 6),
    "fragment_size": 1400,
}
ZENOH: ZenohKeywords = {
    **ROS,
    "locators": ["tcp/robot:7447"],
    "mode": "client",
    "config": "transport/link/tx/lease=2000",
    "type_hashes": True,
    "search": ["interfaces"],
}
ROSBRIDGE: RosbridgeKeywords = {
    "token": "secret",
    "heartbeat": 2,
    "window": 16,
    "limits": LIMITS,
    "tls": None,
    "accepted_after": 1,
    "answer_timeout": 5,
    "schemas": False,
    "cancel_on_disconnect": True,
}
AGENTS: AgentPolicyKeywords = {
    "allow": ["count"],
    "unasked": ["count"],
    "read_only": False,
    "patience": 20,
}
AGENTS_OVER_HTTP: AgentHttpKeywords = {
    **AGENTS,
    "token": "secret",
    "tokens": {"other": "bob"},
    "limits": LIMITS,
    "tls": TLS,
    "insecure": False,
    "hosts": [],
    "origins": [],
}


def settings_of_a_client() -> None:
    connect("tcp://robot", COUNT, **CLIENT, tls=TLS)
    connect("inproc://robot", COUNT, reconnect_timeout=5)
    connect("ros2://", **ROS, node=object(), via="dds")
    connect("dds://", **DDS)
    connect("zenoh://robot", **ZENOH)
    connect("rosbridge://robot", **ROSBRIDGE)
    connect(
        "nats://broker/fleet",
        worker="robot7",
        lease=10,
        user="me",
        password="secret",
        login_token="",
        creds="me.creds",
    )
    blocking.connect("nats://broker/fleet", COUNT, user="me", password="secret")
    connect("tcp://robot", COUNT, hartbeat=2)  # type: ignore[call-overload]  # pyright: ignore[reportCallIssue]
    connect("tcp://robot", heartbeat="2")  # type: ignore[call-overload]  # pyright: ignore[reportArgumentType, reportCallIssue]
    connect("tcp://robot", tokens={})  # type: ignore[call-overload]  # pyright: ignore[reportCallIssue]


async def settings_of_a_call() -> None:
    await call("nats://broker/fleet", COUNT, 3, lease=10, creds="me.creds")


def settings_of_a_server(server: ActionServer[Any, Any, Any]) -> None:
    serve(
        server,
        "https://robot",
        **AGENTS_OVER_HTTP,
        authorize=authorize,
        heartbeat=2,
        orphans="cancel",
        grace=5,
        console=False,
        metrics=Metrics(),
        recording="a.mcap",
        sources=None,
    )
    serve(
        server,
        "ros2://",
        namespace="/robot",
        domain_id=7,
        arguments=["--ros-args"],
        node=object(),
        via="rclpy",
        feedback_depth=10,
        lease=1,
        services_qos="reliable",
        feedback_qos="best_effort",
        status_qos="volatile",
        introspection="contents",
        search=["interfaces"],
        discovery="OFF",
        peers=["robot"],
        network=["10.0.0.2"],
        ip_versions=(4,),
        fragment_size=1400,
        locators=["tcp/robot:7447"],
        mode="peer",
        config="",
        type_hashes=True,
    )
    serve(
        server,
        "nats://broker/fleet",
        worker="robot7",
        replicas=3,
        history_days=7,
        history_goals=None,
        user="me",
        password="secret",
        login_token="",
        creds="me.creds",
    )
    blocking.serve(server, "nats://broker/fleet", replicas=1).forever()
    serve(server, "tcp://robot", grase=1)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    serve(server, "tcp://robot", orphans="kill")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]


def settings_of_transports() -> None:
    InProcessTransport("robot", **CLIENT)
    UnixTransport("/run/robot", **WIRE)
    TcpTransport("robot", **WIRE, tls=TLS, insecure=False)
    WebSocketTransport("robot", **WIRE, tls=TLS, insecure=False, hosts=("robot",), origins=())
    HttpTransport(
        "robot",
        **WIRE,
        tls=TLS,
        insecure=False,
        hosts=("robot",),
        origins=(),
        console=True,
        metrics=None,
        recording=None,
        sources=None,
    )
    WebTransport(**WIRE, hosts=("robot",), origins=(), console=True, metrics=None)
    RosbridgeTransport("robot", **ROSBRIDGE)
    NatsTransport(
        "broker",
        **WIRE,
        worker="robot7",
        lease=10,
        replicas=3,
        history_days=None,
        history_goals=100,
        user="me",
        password="secret",
        login_token="",
        creds="me.creds",
        tls=TLS,
    )
    Ros2Transport(**ROS, node=object(), via="rclpy")
    DdsTransport(**DDS)
    ZenohTransport(**ZENOH)
    McpStdioTransport(**AGENTS)
    McpHttpTransport(**AGENTS_OVER_HTTP)
    A2aHttpTransport(**AGENTS_OVER_HTTP)
    TcpTransport(hartbeat=2)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    UnixTransport("/run/robot", insecure=True)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    NatsTransport("broker", passwort="secret")  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
