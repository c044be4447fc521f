"""Connections by address: what an address is, and which connection makes room for a newcomer."""

from __future__ import annotations

from functools import partial

import pytest

from fibaction.wire.wire_server import Addresses, Candidate, address_of


@pytest.mark.parametrize(
    ("peer", "address"),
    [
        ("127.0.0.1:51234", "127.0.0.1"),
        ("::1:51234", "::/64"),
        ("2001:db8:1:2:3:4:5:6:80", "2001:db8:1:2::/64"),
        ("fe80::1%eth0:80", "fe80::/64"),
        ("::ffff:10.0.0.7:80", "10.0.0.7"),
        ("a local process", ""),
        ("a peer that has left", ""),
        ("worker 7:3", ""),
        ("", ""),
    ],
)
def test_a_peer_is_counted_by_its_address_or_its_network_of_ipv6(peer: str, address: str) -> None:
    assert address_of(peer) == address


def entered(addresses: Addresses, ended: list[str], *peers: str) -> list[Candidate]:
    """Return connections of these peers, which note in `ended` that they are ended."""
    return [Candidate(addresses.enter(peer), partial(ended.append, peer)) for peer in peers]


def test_the_first_connection_of_the_address_with_the_most_makes_room() -> None:
    addresses, ended = Addresses(None), list[str]()
    candidates = entered(addresses, ended, "10.0.0.1:1", "10.0.0.2:1", "10.0.0.2:2", "10.0.0.3:1")
    assert addresses.make_room(candidates)
    assert ended == ["10.0.0.2:1"]
    addresses.leave("10.0.0.2")
    assert addresses.make_room(candidates)
    assert ended == ["10.0.0.2:1", "10.0.0.1:1"]


def test_only_connections_of_an_address_make_room_for_that_address() -> None:
    addresses, ended = Addresses(1), list[str]()
    candidates = entered(addresses, ended, "10.0.0.1:1", "10.0.0.1:2", "10.0.0.2:1")
    assert addresses.make_room(candidates, "10.0.0.2")
    assert ended == ["10.0.0.2:1"]
    assert not addresses.make_room(candidates, "10.0.0.3")


def test_an_address_has_too_many_above_the_limit_and_peers_without_an_address_never() -> None:
    limited, unlimited = Addresses(2), Addresses(None)
    for peer, addresses, has_too_many in (
        ("10.0.0.1:1", limited, True),
        ("a local process", limited, False),
        ("10.0.0.1:1", unlimited, False),
    ):
        counts = [addresses.has_too_many(addresses.enter(peer)) for _ in range(3)]
        assert counts == [False, False, has_too_many]
        addresses.leave(address_of(peer))
        assert not addresses.has_too_many(address_of(peer))
