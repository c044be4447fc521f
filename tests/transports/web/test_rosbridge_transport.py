"""`fibaction_transports.web.rosbridge_transport`: its addresses, its settings, and TLS."""

from __future__ import annotations

import pytest

from fibaction import (
    AuthenticationFailed,
    InvalidURL,
    ProtocolError,
    TransportError,
    connect,
    serve,
)
from fibaction.border.urls import transport_for
from fibaction_transports.web import RosbridgeTransport
from tests.support.certificates import pems
from tests.support.fibonacci import FIBONACCI, Goal, Result
from tests.transports.web.rosbridge.robot import Robot

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize(
    ("url", "shown", "line"),
    [
        ("rosbridge://", "rosbridge://127.0.0.1:9090", "Host: 127.0.0.1:9090"),
        ("rosbridge://robot", "rosbridge://robot:9090", "Host: robot:9090"),
        ("rosbridge://robot:80/arm", "rosbridge://robot:80/arm", "GET /arm HTTP/1.1"),
        ("rosbridges://robot?ca=x", "rosbridges://robot:9090", "Host: robot:9090"),
        ("rosbridge://robot?token=a%20b", "rosbridge://robot:9090", "Authorization: Bearer a b"),
    ],
)
def test_a_url_has_a_host_a_port_and_a_path(url: str, shown: str, line: str) -> None:
    made = transport_for(url)
    assert isinstance(made, RosbridgeTransport)
    assert made.url == shown
    request = made._client_framing().encode([]).decode().split("\r\n")
    assert line in request
    assert not [one for one in request if "Sec-WebSocket-Protocol" in one]


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("rosbridge://user@robot", "it has a user"),
        ("rosbridge://robot:x", "invalid port: "),
        ("rosbridge://robot?ca=x", "has no setting 'ca'"),
        ("rosbridge://robot?orphans=cancel", "has no setting 'orphans'"),
        ("rosbridge://robot?origins=x", "has no setting 'origins'"),
        ("rosbridge://robot?tokens=x", "has no setting 'tokens'"),
        ("rosbridge://robot?limits=x", "cannot have the setting 'limits'"),
        ("rosbridge://robot?accepted_after=soon", "'accepted_after' cannot be 'soon'"),
        ("rosbridge://robot?accepted_after=-1", "accepted_after is at least 0 seconds"),
        ("rosbridge://robot?heartbeat=0", "heartbeat must be between"),
    ],
)
def test_what_is_wrong_in_a_url_is_told(url: str, problem: str) -> None:
    with pytest.raises(InvalidURL, match=problem):
        RosbridgeTransport.from_url(url)


async def test_nothing_is_served_there() -> None:
    with pytest.raises(TransportError, match="rosbridge://robot:9090 is for clients: serve at htt"):
        async with serve(Robot().server, "rosbridge://robot"):
            pass


async def test_a_robot_can_be_behind_tls() -> None:
    async with serve(Robot().server, f"https://127.0.0.1:0?cert={pems().cert}") as (url,):
        where = url.replace("https", "rosbridges")
        async with connect(f"{where}?ca={pems().ca}", FIBONACCI) as client:
            assert await client.call(Goal(3)) == Result([3])
        async with connect(where.replace("rosbridges", "rosbridge"), FIBONACCI) as client:
            with pytest.raises(ProtocolError, match=r"rosbridge://.*: this server speaks TLS"):
                await client.call(Goal(3))
    async with serve(Robot().server, "http://127.0.0.1:0") as (url,):
        where = url.replace("http", "rosbridges")
        async with connect(f"{where}?ca={pems().ca}", FIBONACCI) as client:
            with pytest.raises(AuthenticationFailed, match=r"does not speak TLS.*use rosbridge://"):
                await client.call(Goal(3))
