"""`nats://` URLs, the names in the subjects, and the transport as a whole."""

from __future__ import annotations

import contextlib
import math
import re
import socket
from typing import Any

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction import ActionServer, InvalidURL, ServerNotFound, TransportError, connect, serve
from fibaction.border.urls import transport_for
from fibaction.wire.transport import TlsFiles
from fibaction.words.goal_query import GoalHistory
from fibaction.words.goals import GoalID
from fibaction_transports.nats import NatsTransport
from fibaction_transports.nats.names import (
    FleetNames,
    action_of,
    last_token,
    name_of,
    stream_of_note,
    token_of,
)
from fibaction_transports.nats.settings import FleetSettings
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci
from tests.support.nats_server import NatsServer


def transport_of(url: str, **settings: Any) -> NatsTransport:
    transport = transport_for(url, **settings)
    assert isinstance(transport, NatsTransport)
    return transport


# URLs


def test_a_url_has_brokers_a_login_a_fleet_and_settings() -> None:
    transport = transport_of(
        "nats://me:p%40ss@one,two:5000,[::1]/my%2Ffleet"
        "?worker=robot7&lease=20&replicas=3&creds=/c&token=secret&heartbeat=2"
    )
    settings = transport.settings
    assert settings.servers == ("one:4222", "two:5000", "[::1]:4222")
    assert (settings.user, settings.password, settings.login_token) == ("me", "p@ss", "")
    assert (settings.fleet, settings.worker) == ("my/fleet", "robot7")
    assert (settings.lease, settings.replicas, settings.creds) == (20, 3, "/c")
    assert (settings.token, settings.heartbeat) == ("secret", 2)
    assert transport.url == "nats://one:4222,two:5000,[::1]:4222/my%2Ffleet"


def test_a_history_has_both_bounds_if_one_of_them_is_given() -> None:
    assert transport_of("nats:///f").settings.history is None
    in_days = transport_of("nats:///f?history_days=0.5").settings.history
    in_goals = transport_of("nats:///f?history_goals=7").settings.history
    assert in_days == GoalHistory(seconds=43200)
    assert in_goals == GoalHistory(goals=7)
    both = transport_of("nats:///f", history_days=math.inf, history_goals=8).settings.history
    assert both == GoalHistory(seconds=math.inf, goals=8)


def test_one_word_before_the_at_sign_is_a_token_for_the_brokers() -> None:
    settings = transport_of("nats://s%2Fcret@host/f").settings
    assert (settings.login_token, settings.user) == ("s/cret", "")


def test_tls_files_belong_to_the_scheme_with_tls() -> None:
    transport = transport_of("nats+tls://host/f?ca=a&cert=b&key=c")
    assert transport.settings.tls == TlsFiles("a", "b", "c")
    assert transport.url == "nats+tls://host:4222/f"
    with pytest.raises(InvalidURL, match="has no setting 'ca'"):
        transport_of("nats://host/f?ca=a")


def test_arguments_count_for_more_than_the_url() -> None:
    assert transport_of("nats://host/f?worker=a", worker="b").settings.worker == "b"
    assert NatsTransport(["a", "b:1"], "f").settings.servers == ("a:4222", "b:1")


@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("nats://host", "it does not name a fleet: a URL is like nats://host:4222/fleet"),
        ("nats://host/", "it does not name a fleet"),
        ("nats://host/a/b", "it has more than a fleet behind the brokers"),
        ("nats://host/a/", "it has more than a fleet behind the brokers"),
        ("nats://host:no/f", "invalid broker 'host:no'"),
        ("nats://host:99999/f", "invalid broker 'host:99999'"),
        ("nats://a,,b/f", "invalid broker ''"),
        ("nats://a b/f", "invalid broker 'a b'"),
        ("nats://host/f#x", "part behind #"),
        ("nats://host/f?lease=1", "lease must be between 2 and 3600 s, not 1"),
        ("nats://host/f?lease=x", "the setting 'lease' cannot be 'x'"),
        ("nats://host/f?replicas=4", "replicas must be 1, 3 or 5, not 4"),
        ("nats://host/f?history_days=0", "history_days must be more than 0, not 0"),
        ("nats://host/f?history_goals=0", "history_goals must be 1 or more, not 0"),
        ("nats://host/f?tokens=a", "'tokens': it is given in code"),
        ("nats://host/f?password=a", "'password': it is given in code"),
        ("nats://host/f?worker=a&worker=b", "setting given twice"),
        (f"nats://host/{'%20' * 40}", "the name of the fleet is too long"),
    ],
)
def test_a_url_that_cannot_be_used_is_one_sentence(url: str, error: str) -> None:
    with pytest.raises(InvalidURL) as caught:
        transport_of(url)
    assert error in str(caught.value)


def test_a_login_is_in_no_error() -> None:
    with pytest.raises(InvalidURL) as caught:
        transport_of("nats://me:secret@host/?token=secret")
    assert "secret" not in str(caught.value)


# Connections


def test_trio_is_rejected_in_one_sentence() -> None:
    async def use() -> None:
        transport = transport_of("nats://127.0.0.1:1/f")
        with pytest.raises(TransportError, match="needs asyncio"):
            async with transport.connect():
                pass
        with pytest.raises(TransportError, match="needs asyncio"):
            async with transport.goal_store():
                pass

    anyio.run(use, backend="trio")


@pytest.mark.asyncio
async def test_one_transport_is_one_worker(shared_broker: NatsServer, fleet: str) -> None:
    transport = transport_of(shared_broker.url(fleet, "?worker=w"))
    for _ in range(2):  # the second time, the first one has left
        async with transport.goal_store() as store:
            assert store is not None
            with pytest.raises(TransportError, match="this transport is a worker already"):
                async with transport.goal_store():
                    pass


@pytest.mark.asyncio
async def test_two_endpoints_of_one_name_are_an_error() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    with pytest.raises(TransportError, match="two of the endpoints serve actions of the same name"):
        async with transport_of("nats://127.0.0.1/f").serve(server, server):
            pass


@pytest.mark.asyncio
async def test_one_worker_is_addressed_by_its_name(shared_broker: NatsServer, fleet: str) -> None:
    url = shared_broker.url(fleet)
    async with contextlib.AsyncExitStack() as stack:
        for name in ("one", "two."):
            server = ActionServer(FIBONACCI, fibonacci)
            where = await stack.enter_async_context(serve(server, f"{url}?worker={name}"))
            assert where == (url,)
        client = await stack.enter_async_context(connect(f"{url}?worker=two.", FIBONACCI))
        assert (await (await client.send_goal(Goal(3))).result()).sequence == [0, 1, 1, 2]


@pytest.mark.asyncio
async def test_a_gateway_without_a_store_is_a_worker_as_well(
    shared_broker: NatsServer, fleet: str
) -> None:
    transport = transport_of(shared_broker.url(fleet, "?worker=w"))
    async with ActionServer(FIBONACCI, fibonacci) as server, transport.serve(server) as url:
        assert url == shared_broker.url(fleet)
        async with connect(f"{url}?worker=w", FIBONACCI) as client:
            assert (await (await client.send_goal(Goal(1))).result()).sequence == [0, 1]


@pytest.mark.asyncio
async def test_two_fleets_at_one_broker_do_not_see_each_other(
    shared_broker: NatsServer, fleet: str
) -> None:
    async with serve(ActionServer(FIBONACCI, fibonacci), shared_broker.url(fleet)):
        async with connect(shared_broker.url(fleet + ".other"), FIBONACCI) as client:
            with pytest.raises(ServerNotFound):
                await client.send_goal(Goal(1))


# The settings of a fleet


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
        ({"worker": "." * 34}, "the name of the worker is too long"),
        ({"lease": -1}, "lease must be between"),
        ({"lease": math.nan}, "lease must be between"),
        ({"lease": math.inf}, "lease must be between"),
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


# Names as tokens of subjects


ANY_NAME = st.text(st.characters())  # with surrogates, as in arguments that are not valid text
TOKEN = re.compile(r"[A-Za-z0-9_=-]*")


@given(ANY_NAME)
def test_any_name_is_one_token_and_is_read_back(name: str) -> None:
    token = token_of(name)
    assert TOKEN.fullmatch(token)
    assert name_of(token) == name


@given(ANY_NAME, ANY_NAME)
def test_two_names_are_two_tokens(one: str, other: str) -> None:
    assert (token_of(one) == token_of(other)) == (one == other)


@pytest.mark.parametrize("token", ["=", "=4", "=ZZ", "=FF", "ü"])
def test_what_is_not_such_a_token_is_an_error(token: str) -> None:
    with pytest.raises(ValueError):
        name_of(token)


@given(ANY_NAME.filter(bool), ANY_NAME.filter(bool))
def test_what_subjects_name_can_be_read_from_them(fleet: str, action: str) -> None:
    names, goal_id = FleetNames(fleet), GoalID.random()
    subject = names.goal(action, goal_id)
    assert action_of(subject) == action
    assert last_token(subject) == str(goal_id)
    assert last_token(names.worker(action)) == token_of(action)
    assert {stream_of_note(names.want(action)), stream_of_note(names.left(action))} == {names.notes}
