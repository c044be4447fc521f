"""`fibaction.wire.transport`: what a URL says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fibaction import (
    InvalidURL,
    TransportError,
    connect,
)
from fibaction.wire.settings import Limits
from fibaction_transports.tcp import TcpTransport, TlsFiles, UnixTransport
from tests.transports.tcp.servers import SECRET, refusal

pytestmark = pytest.mark.asyncio


async def test_the_settings_behind_a_url_have_types_and_those_given_count_for_more() -> None:
    url = (
        f"tls://?token={SECRET}&heartbeat=0.5&reconnect=false&reconnect_timeout=7&window=3"
        "&insecure=true&grace=2&orphans=cancel&ca=a&cert=b&key=c"
    )
    made = TcpTransport.from_url(url, window=5)
    keeping = made.settings
    assert (keeping.token, keeping.heartbeat, keeping.window) == (SECRET, 0.5, 5)
    assert (keeping.reconnect, keeping.reconnect_timeout) == (False, 7.0)
    assert made._insecure
    assert (made.settings.grace, made.settings.orphans) == (2.0, "cancel")
    assert made.settings.heartbeat == 0.5
    assert made._tls == TlsFiles("a", "b", "c")
    local = UnixTransport.from_url("unix:///run/a%20b?window=3&reconnect=true", window=4)
    assert (local._path, local.settings.window) == (Path("/run/a b"), 4)


ALL_HAVE = "token, heartbeat, window, reconnect, reconnect_timeout, orphans, grace"


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        (
            f"tcp://robot?tokem={SECRET}",
            (
                "tcp://robot has no setting 'tokem': did you mean 'token'?"
                f" Its settings are {ALL_HAVE}, insecure"
            ),
        ),
        (
            f"tcp://robot?window=few&token={SECRET}",
            "tcp://robot: the setting 'window' cannot be 'few'",
        ),
        (
            f"tcp://robot?token={SECRET}&reconnect=maybe",
            "tcp://robot: the setting 'reconnect' cannot be 'maybe'",
        ),
        (
            "tcp://robot?ca=x",
            f"tcp://robot has no setting 'ca'; its settings are {ALL_HAVE}, insecure",
        ),
        ("tcp://robot?insecure=", "tcp://robot: the setting 'insecure' cannot be ''"),
        ("tcp://robot:99999", "tcp://robot:99999: invalid port: Port out of range 0-65535"),
        (
            "tcp://robot:-1",
            "tcp://robot:-1: invalid port: Port could not be cast to integer value as '-1'",
        ),
        ("unix://", "unix://: the URL of a socket is like unix:///run/robot.sock"),
        ("unix://x/y", "unix://x/y: the URL of a socket is like unix:///run/robot.sock"),
    ],
)
async def test_a_bad_url_is_refused_in_one_sentence(url: str, problem: str) -> None:
    with pytest.raises(TransportError) as caught:
        connect(url)
    assert type(caught.value) is InvalidURL
    assert str(caught.value) == problem


GOOD: dict[str, Any] = {
    "tokens": {SECRET: "ann"},
    "authorize": lambda *_: True,
    "limits": Limits(),
}


@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("where", ["tcp://robot", "tls://robot", "unix:///run/x"])
async def test_a_setting_that_is_given_in_code_only_is_told_apart_from_one_that_is_not_there(
    where: str, name: str
) -> None:
    url = f"{where}?{name}={SECRET}"
    refused = await refusal(url)
    assert refused == (
        f"{where} cannot have the setting {name!r}: it is given in code, as in"
        f" serve(..., {name}=...), and not in a URL, which ends up in logs"
    )
    # In code there is such a setting indeed.
    assert TcpTransport(**{name: GOOD[name]}) is not None


@pytest.mark.parametrize("url", ["tcp://[::1", "tcp://robot?heartbeat=0", "tcp://robot?window=-1"])
async def test_a_bad_url_is_a_transport_error_whatever_is_bad(url: str) -> None:
    with pytest.raises(TransportError):
        connect(url)


@pytest.mark.parametrize(
    ("url", "what"),
    [
        (f"tcp://me:{SECRET}@robot:7400", "tcp://robot:7400: it has a user"),
        (f"tls://{SECRET}@robot?ca=x", "tls://robot: it has a user"),
        ("tcp://@robot", "tcp://robot: it has a user"),
        ("tcp://robot:7400/arm", "tcp://robot:7400/arm: it has a path"),
        ("tcp:///run/robot.sock", "tcp:///run/robot.sock: it has a path"),
    ],
)
async def test_what_a_url_says_besides_is_refused_and_not_left_out_silently(
    url: str, what: str
) -> None:
    with pytest.raises(TransportError) as caught:
        connect(url)
    assert str(caught.value) == (
        f"{what}, and the URL of a server is like {url[:3]}://host:port,"
        f" with settings after ? such as token="
    )
    assert TcpTransport.from_url("tcp://robot:7400/").url == "tcp://robot:7400"


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("unix:///run/robot#1.sock", "unix:///run/robot#1.sock"),
        ("unix:///run/robot#", "unix:///run/robot#"),
        (f"unix:///run/x?token={SECRET}#1", "unix:///run/x"),
        ("tcp://robot:7400#arm", "tcp://robot:7400#arm"),
        (f"tcp://robot?token={SECRET}#1", "tcp://robot"),
        (f"tls://{SECRET}@robot?ca=x#y", "tls://robot"),
    ],
)
async def test_a_url_is_not_cut_off_silently_at_a_number_sign(url: str, shown: str) -> None:
    with pytest.raises(TransportError) as caught:
        connect(url)
    assert str(caught.value) == (
        f"{shown} has a part behind #, which has no meaning here: write %23 if the # belongs to a"
        f" path or a token"
    )


async def test_a_number_sign_that_belongs_to_a_path_or_a_token_is_written_as_a_number() -> None:
    made = UnixTransport.from_url("unix:///run/robot%231.sock?token=%23a")
    assert (made._path, made.settings.token) == (Path("/run/robot#1.sock"), "#a")


async def test_of_two_values_of_one_setting_none_is_left_out_silently() -> None:
    with pytest.raises(TransportError) as caught:
        connect(f"tcp://robot?token={SECRET}&token=b")
    assert str(caught.value) == "tcp://robot: setting given twice"


async def test_a_socket_whose_path_cannot_be_is_refused() -> None:
    await refusal("unix:///tmp/a%00b")
