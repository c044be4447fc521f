"""`dds://node_name`: actions of ROS 2 where no ROS is installed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from fibaction.border.abc import Diagnosis
from fibaction.border.urls import check_settings, without_settings
from fibaction.words.errors import InvalidURL
from fibaction_transports.ros2.on_dds.dds_adapter import DdsAdapter, DdsSettings
from fibaction_transports.ros2.ros_transport import (
    IN_URLS,
    RosTransport,
    shared_settings,
    url_parts,
)
from fibaction_transports.ros2.settings import (
    LAST_DOMAIN,
    EndSettings,
    NodeSettings,
    check_range,
)


def _words(text: str) -> tuple[str, ...]:
    return tuple(filter(None, (word.strip() for word in text.split(","))))


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(map(int, _words(text)))


DDS_IN_URLS: Final[Mapping[str, Callable[[str], Any]]] = {
    **IN_URLS,
    "search": _words,
    "discovery": str,
    "peers": _words,
    "network": _words,
    "ip_versions": _numbers,
    "fragment_size": int,
}
"""The settings that a URL may have, and their types."""


class DdsTransport(RosTransport):
    """The actions of a ROS graph, over our own DDS."""

    scheme = "dds"

    def __init__(
        self,
        node_name: str | None = None,
        *,
        namespace: str = "",
        domain_id: int | None = None,
        arguments: Sequence[str] | None = None,
        feedback_depth: int = 1000,
        discovery_timeout: float = 4.0,
        lease: float = 2.0,
        reconnect: bool = True,
        reconnect_timeout: float = 10.0,
        services_qos: str = "",
        feedback_qos: str = "",
        status_qos: str = "",
        search: Sequence[str] = (),
        discovery: str = "",
        peers: Sequence[str] = (),
        network: Sequence[str] = (),
        ip_versions: Sequence[int] = (),
        fragment_size: int = 63_000,
    ) -> None:
        """Describe the node; nothing is made yet. Each `serve` and `connect` makes its own.

        The settings that are not described here are those of `Ros2Transport`.

        Args:
            node_name: The name of the node; None makes a unique name.
            namespace: The namespace of the node, and of relative names of actions.
            domain_id: The ROS domain; None takes ROS_DOMAIN_ID from the environment.
            arguments: ROS's arguments on a command line; None takes the program's own.
            feedback_depth: The number of feedback messages that are kept.
            discovery_timeout: Seconds for which a new client waits if it finds no server.
            lease: Seconds without a sign of life after which a server counts as silent.
            reconnect: False ends waiting calls with `ConnectionLost` as soon as their server is
                silent.
            reconnect_timeout: Seconds that a client waits for a silent server to come back.
            services_qos: The quality of service of the three services.
            feedback_qos: That of the feedback topic.
            status_qos: That of the status topic.
            search: Folders with packages of interface files: `package/action/Type.action` and
                `package/msg/Type.msg`. They are searched before those of `FIBACTION_SEARCH` and
                those of ROS. In a URL, they are separated by commas.
            discovery: `SUBNET`, `LOCALHOST` or `OFF`: how far other nodes are looked for. Without
                it, ROS_AUTOMATIC_DISCOVERY_RANGE says it, and else it is `SUBNET`, as in ROS.
            peers: Hosts that are asked in addition, where multicast does not reach; without them,
                those of ROS_STATIC_PEERS.
            network: The addresses of this machine's interfaces that take part in multicast; by
                default that of the default route.
            ip_versions: The versions of IP that are used: `(4,)`, `(6,)` or `(4, 6)`, in a URL
                `ip_versions=4,6`. By default 4, and 6 as well if a peer is an address of IPv6.
            fragment_size: Bytes of a message that go into one datagram, from 256 to 63,000. Where
                much is lost, a size below the MTU loses less.

        Raises:
            ValueError: A number is out of range, or a word is not valid.
        """
        check_range("domain_id", domain_id or 0, 0, LAST_DOMAIN)
        ends = EndSettings(
            feedback_depth=feedback_depth,
            discovery_timeout=discovery_timeout,
            lease=lease,
            reconnect=reconnect,
            reconnect_timeout=reconnect_timeout,
            services_qos=services_qos,
            feedback_qos=feedback_qos,
            status_qos=status_qos,
        )
        settings = DdsSettings(
            search=tuple(search),
            discovery=discovery,
            peers=tuple(peers),
            network=tuple(network),
            ip_versions=tuple(ip_versions),
            fragment_size=fragment_size,
        )
        node = NodeSettings(node_name or "", namespace, domain_id, arguments)
        shared = shared_settings(namespace, domain_id, ends)
        shared |= {
            "discovery": discovery or None,
            "peers": ",".join(peers) or None,
            "ip_versions": ",".join(map(str, ip_versions)) or None,
        }
        self._dds = DdsAdapter(node, settings)
        super().__init__(self._dds, ends, shared)

    async def diagnose(self, seconds: float, action: str = "") -> Diagnosis:
        """See `Transport.diagnose`."""
        from fibaction_transports.ros2.on_dds.diagnosis import diagnose_domain  # needed here only

        return await diagnose_domain(self._dds, self._ends, seconds, action)

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> DdsTransport:
        """Make a transport from `dds://node_name`, where the name may be left out.

        All settings that are text or numbers can be in the URL, after `?`.

        Raises:
            InvalidURL: The URL is not valid; the text says what is wrong.
            TypeError: There is no such setting.
        """
        check_settings(cls.__name__, settings, (*DDS_IN_URLS, "arguments"))
        name, found = url_parts(url, DDS_IN_URLS)
        try:
            return cls(name, **{**found, **settings})
        except ValueError as exc:
            raise InvalidURL(f"{without_settings(url)}: {exc}") from exc
