"""The diagnosis of `dds://`: what was heard, and the advice that follows from it."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import Action, ActionServer, GoalHandle, serve
from fibaction.border.abc import Diagnosis
from fibaction.border.urls import transport_for
from fibaction_transports.ros2.on_dds.diagnosis import DomainView, _groups, advice
from fibaction_transports.rtps.network import open_network
from fibaction_transports.rtps.participant import Participant, ParticipantSettings
from fibaction_transports.rtps.ports import (
    LOCALHOST,
    DiscoveryRange,
    DomainSettings,
    discovery_port,
)
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.fibonacci import FIBONACCI, fibonacci

PATIENCE = 20.0
ANY = DomainView(
    settings=DomainSettings(domain=7, discovery_range=DiscoveryRange.SUBNET),
    interfaces=("192.0.2.1",),
    peers=[],
    participants=[{"host": "192.0.2.9"}],
    nodes=["/robot"],
    actions=[{"name": "/stir"}],
    datagrams={"received": 1, "own": 1, "of_other_domains": 0},
    is_only_here=False,
    ports=(9160, 9161),
)
"""The view of a network on which all is well."""
NOTHING: dict[str, Any] = {"participants": [], "nodes": [], "actions": [], "is_only_here": True}
SILENT = {**ANY.datagrams, "received": 0}


def with_range(name: str, *peers: str) -> DomainSettings:
    return DomainSettings(domain=7, discovery_range=DiscoveryRange[name], static_peers=peers)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, []),
        ({"actions": []}, ["none of them serves an action"]),
        ({"nodes": []}, ["a firewall may block the UDP ports 9160 and 9161 here"]),
        ({"is_only_here": True}, ["only programs of this machine were heard: multicast may be"]),
        (
            {"peers": [{"host": "robot", "heard": False}, {"host": "arm", "heard": True}]},
            ["nothing was heard from the static peer robot: does it let UDP in?"],
        ),
        (NOTHING, ["datagrams have arrived, and none of them announced a participant"]),
        ({**NOTHING, "datagrams": SILENT}, ["is ROS_DOMAIN_ID 7 there, too?"]),
        ({**NOTHING, "datagrams": {**SILENT, "own": 0}}, ["this machine blocks multicast"]),
        (
            {**NOTHING, "datagrams": {**SILENT, "of_other_domains": 1}},
            ["in another domain than 7, or has a domain tag"],
        ),
        ({**NOTHING, "settings": with_range("OFF")}, ["discovery is OFF"]),
        (
            {**NOTHING, "datagrams": SILENT, "settings": with_range("LOCALHOST")},
            ["other machines are not looked for: use discovery=SUBNET"],
        ),
        (
            {**NOTHING, "datagrams": SILENT, "interfaces": (LOCALHOST,)},
            ["multicast has only the loopback interface here; is there a network?"],
        ),
    ],
)
def test_the_advice_follows_from_what_was_heard(
    changes: dict[str, Any], expected: list[str]
) -> None:
    found = list(advice(msgspec.structs.replace(ANY, **changes), []))
    assert len(found) == len(expected)
    for sentence, text in zip(found, expected, strict=True):
        assert text in sentence


async def until(
    is_heard: Callable[[Diagnosis], object], url: str = "dds://", action: str = ""
) -> Diagnosis:
    """Diagnose again, each time for longer, until something was heard."""
    seconds = 0.2
    with anyio.fail_after(PATIENCE):
        while True:
            found = await transport_for(url, arguments=[]).diagnose(seconds, action)
            if is_heard(found):
                return found
            seconds *= 2


def has_actions(found: Diagnosis) -> bool:
    return bool(found.facts["actions"] and found.facts["actions"][0]["servers"])


@pytest.mark.anyio
async def test_a_server_is_heard_with_its_node_type_and_participant() -> None:
    async with serve(ActionServer(FIBONACCI, fibonacci), "dds://cook"):
        found = await until(has_actions, "dds://?peers=localhost", "fibonacci")
    domain = int(os.environ["ROS_DOMAIN_ID"])
    facts = found.facts
    number = facts["own_ports"]["participant"]

    assert found.is_found
    assert facts["domain"] == {"number": domain, "from": "ROS_DOMAIN_ID"}
    assert facts["discovery"] == {"range": "LOCALHOST", "from": "ROS_AUTOMATIC_DISCOVERY_RANGE"}
    assert facts["static_peers"] == [
        {"host": "localhost", "address": LOCALHOST, "from": "setting peers", "heard": True}
    ]
    assert facts["own_ports"]["discovery"] == discovery_port(domain, number)
    assert facts["multicast"]["joined_at"] == []
    (participant,) = facts["participants"]
    assert participant["vendor"] == "fibaction"
    assert participant["endpoints"] > 5
    assert "/cook" in facts["nodes"]
    assert facts["actions"] == [
        {"name": "/fibonacci", "type": "arduinobot_msgs/action/Fibonacci", "servers": ["/cook"]}
    ]
    assert facts["datagrams"]["received"] > 0
    assert facts["problems"] == []


@pytest.mark.anyio
async def test_the_settings_and_the_defaults_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    domain = os.environ["ROS_DOMAIN_ID"]
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    found = await transport_for("dds://").diagnose(0.01)
    assert found.facts["discovery"] == {"range": "LOCALHOST", "from": "ROS_LOCALHOST_ONLY"}
    assert not found.is_found

    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"):
        monkeypatch.delenv(name)
    url = f"dds://?domain_id={domain}&network=127.0.0.1"
    found = await transport_for(url).diagnose(0.01)
    assert found.facts["domain"]["from"] == "setting domain_id"
    assert found.facts["discovery"] == {"range": "SUBNET", "from": "default"}
    assert found.facts["multicast"]["joined_at"] == ["127.0.0.1"]


def test_the_groups_of_each_version_of_ip_are_told() -> None:
    settings = DomainSettings(domain=7, ip_versions=(4, 6))
    assert list(_groups(settings)) == [
        "239.255.0.1:9150",
        "[ff1e::ffff:efff:1]:9150",
        "[ff02::ffff:efff:1]:9150",
    ]


@pytest.mark.anyio
async def test_a_discovery_server_is_said_to_be_left_out(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", "")
    found = await transport_for("dds://", arguments=[]).diagnose(0.01)
    assert "ROS_DISCOVERY_SERVER" not in f"{found.advice} {caplog.messages}"
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", "robot:11811")
    found = await transport_for("dds://", arguments=[]).diagnose(0.01)
    sentence = "ROS_DISCOVERY_SERVER=robot:11811 is not followed: dds:// does not speak to"
    assert found.advice[-1].startswith(sentence)
    assert [one.startswith(sentence) for one in caplog.messages] == [True]


@pytest.mark.anyio
async def test_a_participant_without_nodes_is_told() -> None:
    domain = DomainSettings(domain=int(os.environ["ROS_DOMAIN_ID"]))
    async with open_network(domain, lambda _: None, name="stranger"):
        found = await until(lambda found: found.is_found)
    assert found.facts["participants"][0]["name"] == "stranger"
    assert found.facts["nodes"] == []
    assert "none of their nodes" in found.advice[0]


@pytest.mark.anyio
async def test_a_participant_of_another_domain_is_told() -> None:
    here = int(os.environ["ROS_DOMAIN_ID"])
    ports = [(LOCALHOST, discovery_port(here, number)) for number in range(20)]
    with anyio.fail_after(PATIENCE), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        async def call_out() -> None:
            while True:
                stranger = Participant(
                    ParticipantSettings(
                        discovery_addresses=((LOCALHOST, 1),),
                        data_addresses=((LOCALHOST, 2),),
                        announce_to=tuple(ports),
                        domain=here + 1,
                    ),
                    time.monotonic(),
                )
                for datagram, address in stranger.datagrams_to_send():
                    sender.sendto(datagram, address)
                await anyio.sleep(0.01)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(call_out)
            found = await until(lambda found: found.facts["datagrams"]["of_other_domains"] > 0)
            tasks.cancel_scope.cancel()
    assert not found.is_found
    assert f"in another domain than {here}" in found.advice[0]


# An action that cannot be used


class Rounds(msgspec.Struct):
    rounds: int


class Round(msgspec.Struct):
    round: int


class Said(msgspec.Struct):
    said: str


def stir(name: str, folder: Path, number: str = "int32") -> tuple[ActionServer[Any, Any, Any], str]:
    """Return a server of an action whose interface file is in this folder, and its URL."""
    type_name = f"kitchen_msgs/action/{name}"
    path = folder / f"{type_name}.action"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"int32 rounds\n---\nstring said\n---\n{number} round\n")
    action = Action("stir", goal=Rounds, feedback=Round, result=Said, type_name=type_name)

    async def run(goal: GoalHandle[Any]) -> AsyncGenerator[Any, None]:
        yield Said("smooth")  # pragma: no cover

    return ActionServer(action, run), f"dds://?search={folder}"


async def problems(url: str, action: str = "stir") -> list[str]:
    """Return what is said of an action when its server is heard."""
    found = await until(has_actions, url, action)
    assert not found.is_found
    assert found.advice[-len(found.facts["problems"]) :] == tuple(found.facts["problems"])
    return list(found.facts["problems"])


@pytest.mark.anyio
async def test_a_misspelt_action_suggests_the_near_one(tmp_path: Path) -> None:
    server, url = stir("Stir", tmp_path)
    async with serve(server, url):
        told = await problems(url, "stirr")
    assert told == ["the action /stirr has no server; did you mean /stir?"]


@pytest.mark.anyio
async def test_a_mismatch_of_qos_is_told(tmp_path: Path) -> None:
    server, url = stir("Stir", tmp_path)
    async with serve(server, f"{url}&feedback_qos=best_effort"):
        (told,) = await problems(url)
    assert told.startswith("/stir: there is a server, and its QoS does not match: feedback")


@pytest.mark.anyio
async def test_a_type_that_is_not_known_here_is_told(tmp_path: Path) -> None:
    server, url = stir("Stir", tmp_path)
    async with serve(server, url):
        (told,) = await problems("dds://")
    assert told.startswith("kitchen_msgs/action/Stir is not known here: put")


@pytest.mark.anyio
async def test_another_version_of_a_type_is_told(tmp_path: Path) -> None:
    server, url = stir("Stir", tmp_path / "robot", "int64")
    _, here = stir("Stir", tmp_path / "here")
    async with serve(server, url):
        (told,) = await problems(here)
    assert told.startswith("the feedback of kitchen_msgs/action/Stir has other fields")


@pytest.mark.anyio
async def test_servers_of_two_types_are_told(tmp_path: Path) -> None:
    (one, url), (other, _) = stir("Stir", tmp_path), stir("Shake", tmp_path)
    async with serve(one, url), serve(other, url):
        found = await until(
            lambda found: len(found.facts["participants"]) == 2 and has_actions(found), url, "stir"
        )
        while not found.facts["problems"]:
            found = await until(has_actions, url, "stir")
    types = "kitchen_msgs/action/Shake, kitchen_msgs/action/Stir"
    assert found.facts["problems"] == [f"/stir has servers of several types: {types}"]
