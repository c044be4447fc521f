"""The ports of a domain, and what the variables of ROS mean."""

from __future__ import annotations

import pytest

from fibaction_transports.rtps.ports import (
    DiscoveryRange,
    DomainSettings,
    announced_addresses,
    data_port,
    discovery_port,
    multicast_port,
)


def test_the_ports_are_those_of_the_specification() -> None:
    assert (multicast_port(0), discovery_port(0, 0), data_port(0, 0)) == (7400, 7410, 7411)
    assert (multicast_port(77), discovery_port(77, 3), data_port(77, 3)) == (26650, 26666, 26667)


def test_ros_looks_in_the_subnet_if_nothing_is_said() -> None:
    settings = DomainSettings.from_environment({})
    assert settings == DomainSettings(discovery_range=DiscoveryRange.SUBNET)
    assert announced_addresses(settings, ()) == (("239.255.0.1", 7400),)
    empty = {"ROS_DOMAIN_ID": "", "ROS_AUTOMATIC_DISCOVERY_RANGE": "", "ROS_STATIC_PEERS": ""}
    assert DomainSettings.from_environment(empty) == settings
    word = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}
    assert DomainSettings.from_environment(word) == settings


def test_on_this_machine_the_first_participants_are_announced_to() -> None:
    environment = {"ROS_DOMAIN_ID": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    settings = DomainSettings.from_environment(environment)
    addresses = announced_addresses(settings, ())
    assert len(addresses) == 32
    assert (addresses[0], addresses[-1]) == (("127.0.0.1", 7660), ("127.0.0.1", 7722))
    assert announced_addresses(settings, (), 31) == addresses
    later = announced_addresses(settings, (), 40)
    assert (len(later), later[:32]) == (40, addresses)
    assert DomainSettings.from_environment({"ROS_LOCALHOST_ONLY": "1"}) == DomainSettings()


def test_the_first_participants_of_static_peers_are_announced_to() -> None:
    settings = DomainSettings.from_environment({"ROS_STATIC_PEERS": "robot; 10.0.0.7;;"})
    assert settings.static_peers == ("robot", "10.0.0.7")
    assert announced_addresses(settings, ("10.0.0.6",))[1:] == (
        ("10.0.0.6", 7410),
        ("10.0.0.6", 7412),
        ("10.0.0.6", 7414),
        ("10.0.0.6", 7416),
    )


@pytest.mark.parametrize("peers", ["", "robot;fd00::7"])
def test_ipv6_is_used_if_it_is_set_or_a_static_peer_has_such_an_address(peers: str) -> None:
    environment = {"ROS_STATIC_PEERS": peers, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    usual = DomainSettings.from_environment(environment).ip_versions
    assert usual == ((4, 6) if peers else (4,))
    settings = DomainSettings.from_environment(environment, (6,))
    assert settings.ip_versions == (6,)
    assert announced_addresses(settings, ())[::31] == (("::1", 7410), ("::1", 7472))
    with pytest.raises(ValueError, match=r"versions \(5,\) of IP are not 4, 6, or both"):
        DomainSettings(ip_versions=(5,))


def test_both_versions_of_ip_are_announced_to_with_the_groups_of_both_middlewares() -> None:
    settings = DomainSettings(discovery_range=DiscoveryRange.SUBNET, ip_versions=(4, 6))
    assert announced_addresses(settings, ("fd00::7",))[:4] == (
        ("239.255.0.1", 7400),
        ("ff1e::ffff:efff:1", 7400),
        ("ff02::ffff:efff:1", 7400),
        ("fd00::7", 7410),
    )


def test_nobody_is_announced_to_if_discovery_is_off() -> None:
    settings = DomainSettings.from_environment({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"})
    assert announced_addresses(settings, ("10.0.0.6",)) == ()


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"ROS_DOMAIN_ID": "one"}, "ROS_DOMAIN_ID='one' is not a number"),
        ({"ROS_DOMAIN_ID": "233"}, "domain 233 is not between 0 and 232"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "MARS"}, "'MARS' is not one of SUBNET, LOCALHOST, OFF"),
    ],
)
def test_a_value_that_ros_does_not_know_is_an_error(
    environment: dict[str, str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        DomainSettings.from_environment(environment)
