"""The settings of a fleet."""

from __future__ import annotations

import math
import socket
from typing import Any

import pytest

from fibaction import TransportError
from fibaction.wire.tls_files import TlsFiles
from fibaction_transports.nats.settings import FleetSettings


def test_the_url_has_no_logins_and_no_settings() -> None:
    settings = FleetSettings(
        "a b/ü",
        ("one:4222", "[::1]:1"),
        worker="w",
        user="me",
        password="secret",
        login_token="secret",
    )
    assert settings.url == "nats://one:4222,[::1]:1/a%20b%2F%C3%BC"
    assert repr(settings) == "<FleetSettings>"
    assert FleetSettings("f", tls=TlsFiles()).url == "nats+tls://127.0.0.1:4222/f"


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"fleet": ""}, "the fleet has no name"),
        ({"fleet": "x" * 101}, "the name of the fleet is too long"),
        ({"worker": "." * 34}, "the name of the worker is too long"),
        ({"lease": 1.9}, "lease must be between 2 and 3600 s, not 1.9"),
        ({"lease": -1}, "lease must be between"),
        ({"lease": math.nan}, "lease must be between"),
        ({"lease": math.inf}, "lease must be between"),
        ({"replicas": 2}, "replicas must be 1, 3 or 5, not 2"),
    ],
)
def test_values_that_cannot_be_are_one_sentence(settings: dict[str, Any], error: str) -> None:
    with pytest.raises(ValueError, match=error):
        FleetSettings(**{"fleet": "f", **settings})


@pytest.mark.parametrize(("brokers", "lease"), [(1, 5), (2, 5), (3, 15), (5, 15)])
def test_a_worker_gets_a_name_and_a_lease_that_fits_the_brokers(brokers: int, lease: float) -> None:
    settings = FleetSettings("f").of_worker(brokers)
    assert settings.lease == lease
    assert settings.worker.startswith(socket.gethostname()[:40])
    given = FleetSettings("f", worker="w", lease=12.0).of_worker(brokers)
    assert (given.worker, given.lease) == ("w", 12)


def test_a_lease_that_is_shorter_than_the_failover_is_rejected() -> None:
    assert FleetSettings("f", lease=2.0).of_worker(1).lease == 2
    with pytest.raises(TransportError, match="a lease of 11 s is too short for 3 brokers"):
        FleetSettings("f", lease=11.0).of_worker(3)
