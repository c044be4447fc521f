"""The settings of the transports as keyword arguments, for type checkers.

Made from the settings of each transport by `python -m tests.tools.setting_keywords`, and not to be
changed by hand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from ssl import SSLContext
from typing import Any, Literal, TypedDict

from fibaction.observe.metrics import Metrics
from fibaction.observe.sources import Sources
from fibaction.wire.auth import Authorize
from fibaction.wire.settings import Limits
from fibaction.wire.transport import TlsFiles


class AgentPolicyKeywords(TypedDict, total=False):
    """The keyword arguments of `AgentPolicy`."""

    allow: Sequence[str]
    unasked: Sequence[str]
    read_only: bool
    patience: float


class LineKeywords(TypedDict, total=False):
    """The keyword arguments of `LineSettings`."""

    token: str
    heartbeat: float
    window: int
    limits: Limits


class RosKeywords(TypedDict, total=False):
    """The keyword arguments of `RosSettings`."""

    namespace: str
    domain_id: int | None
    arguments: Sequence[str] | None
    feedback_depth: int
    discovery_timeout: float
    lease: float
    reconnect: bool
    reconnect_timeout: float
    services_qos: str
    feedback_qos: str
    status_qos: str
    introspection: str


class AgentHttpKeywords(AgentPolicyKeywords, total=False):
    """The keyword arguments of `AgentHttpSettings`."""

    token: str
    tokens: Mapping[str, str] | None
    limits: Limits
    tls: TlsFiles | SSLContext | None
    insecure: bool
    hosts: Sequence[str]
    origins: Sequence[str]


class ClientKeywords(LineKeywords, total=False):
    """The keyword arguments of `ClientSettings`."""

    reconnect: bool
    reconnect_timeout: float


class OwnNodeKeywords(RosKeywords, total=False):
    """The keyword arguments of `OwnNodeSettings`."""

    search: Sequence[str]


class Ros2Keywords(RosKeywords, total=False):
    """The keyword arguments of `Ros2Settings`."""

    node: Any
    via: Literal["", "rclpy", "dds", "zenoh"]


class RosbridgeKeywords(LineKeywords, total=False):
    """The keyword arguments of `RosbridgeSettings`."""

    tls: TlsFiles | SSLContext | None
    accepted_after: float
    answer_timeout: float
    schemas: bool
    cancel_on_disconnect: bool


class DdsKeywords(OwnNodeKeywords, total=False):
    """The keyword arguments of `DdsSettings`."""

    discovery: str
    peers: Sequence[str]
    network: Sequence[str]
    ip_versions: Sequence[int]
    fragment_size: int


class WireKeywords(ClientKeywords, total=False):
    """The keyword arguments of `WireSettings`."""

    tokens: Mapping[str, str] | None
    authorize: Authorize | None
    orphans: Literal["keep", "cancel"]
    grace: float


class ZenohKeywords(OwnNodeKeywords, total=False):
    """The keyword arguments of `ZenohSettings`."""

    locators: Sequence[str]
    mode: Literal["", "peer", "client"]
    config: str
    type_hashes: bool


class HostKeywords(WireKeywords, total=False):
    """The keyword arguments of `HostSettings`."""

    tls: TlsFiles | SSLContext | None
    insecure: bool


class NatsKeywords(WireKeywords, total=False):
    """The keyword arguments of `NatsSettings`."""

    worker: str
    lease: float
    replicas: int
    history_days: float | None
    history_goals: int | None
    user: str
    password: str
    login_token: str
    creds: str
    tls: TlsFiles | SSLContext | None


class WebKeywords(WireKeywords, total=False):
    """The keyword arguments of `WebSettings`."""

    hosts: Sequence[str]
    origins: Sequence[str]
    console: bool
    metrics: Metrics | None


class WebSocketKeywords(HostKeywords, total=False):
    """The keyword arguments of `WebSocketSettings`."""

    hosts: Sequence[str]
    origins: Sequence[str]


class HttpKeywords(WebSocketKeywords, total=False):
    """The keyword arguments of `HttpSettings`."""

    console: bool
    metrics: Metrics | None
    recording: str | PathLike[str] | None
    sources: Sources | None


class ConnectKeywords(
    ClientKeywords, Ros2Keywords, RosbridgeKeywords, DdsKeywords, ZenohKeywords, total=False
):
    """The settings that `connect` passes on to the transport of a URL."""

    worker: str
    user: str
    password: str
    login_token: str
    creds: str


class ServeKeywords(AgentHttpKeywords, total=False):
    """The settings that `serve` passes on to the transports of URLs."""

    heartbeat: float
    namespace: str
    domain_id: int | None
    arguments: Sequence[str] | None
    feedback_depth: int
    lease: float
    services_qos: str
    feedback_qos: str
    status_qos: str
    introspection: str
    node: Any
    via: Literal["", "rclpy", "dds", "zenoh"]
    search: Sequence[str]
    discovery: str
    peers: Sequence[str]
    network: Sequence[str]
    ip_versions: Sequence[int]
    fragment_size: int
    authorize: Authorize | None
    orphans: Literal["keep", "cancel"]
    grace: float
    locators: Sequence[str]
    mode: Literal["", "peer", "client"]
    config: str
    type_hashes: bool
    worker: str
    replicas: int
    history_days: float | None
    history_goals: int | None
    user: str
    password: str
    login_token: str
    creds: str
    console: bool
    metrics: Metrics | None
    recording: str | PathLike[str] | None
    sources: Sources | None
