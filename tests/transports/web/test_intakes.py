"""`.../intake`: how an action takes goals, told and changed by REST."""

from __future__ import annotations

import anyio
import pytest

from fibaction import Peer, Permission, ServerNotFound, connect, serve
from fibaction.border.abc import Endpoint, ForwardingEndpoint, Intake, IntakeChange
from fibaction.border.http_access import Refused
from fibaction.words.intake import NO_LEVERS
from fibaction_transports.web.rest.actions import wanted_in
from tests.support.fibonacci import FIBONACCI
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

ACTION = "/actions/fibonacci"
HTTP = "http://127.0.0.1:0"


async def test_an_action_is_paused_and_resumed_and_its_list_tells_it_also_at_a_bridge() -> None:
    with anyio.fail_after(30):
        async with (
            serve(new_server(), "tcp://127.0.0.1:0") as (robot,),
            connect(robot) as there,
            serve(there.endpoint(FIBONACCI), HTTP) as (url,),
        ):
            assert "intake" not in (await fetch(url, "GET", "/actions")).json[0]
            pause = {"mode": "refuse", "reason": "wet floor"}
            paused = (await fetch(url, "PUT", f"{ACTION}/intake", pause)).json
            assert paused == (await fetch(url, "GET", f"{ACTION}/intake")).json
            for path in ("/actions", ACTION):
                listed = (await fetch(url, "GET", path)).json
                told = (listed[0] if path == "/actions" else listed)["intake"]
                assert told["mode"] == "refuse"
                assert told["text"].endswith(": wet floor")
            rejected = await fetch(url, "POST", f"{ACTION}/goals", {"order": 3})
            assert (rejected.status, rejected.headers["retry-after"]) == (503, "1")
            assert (rejected.json["code"], "wet floor" in rejected.json["detail"]) == ("BUSY", True)
            await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "open"})
            answer = await fetch(url, "POST", f"{ACTION}/goals?wait=20", {"order": 3})
            assert answer.json["status"] == "SUCCEEDED"
            worker = {"mode": "drain", "worker": "arm-1"}
            refused = await fetch(url, "PUT", f"{ACTION}/intake", worker)
            assert (refused.status, "has no workers" in refused.json["detail"]) == (409, True)
    [change] = paused["changes"]
    assert (change["mode"], change["reason"]) == ("refuse", "wet floor")
    assert ", for 127.0.0.1:" in change["by"]


async def test_who_may_not_operate_is_refused() -> None:
    def authorize(_peer: Peer, _action: str, permission: Permission) -> bool:
        return permission is Permission.OBSERVE

    async with serve(new_server(), HTTP, authorize=authorize) as (url,):
        answer = await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "hold"})
        assert answer.status == 403
        told = (await fetch(url, "GET", f"{ACTION}/intake")).json
        assert (told["mode"], told["changes"], told["has_levers"]) == ("open", [], True)


@pytest.mark.parametrize("body", [b"", b"[]", b'{"mode": "stop"}', b'{"mode": "hold", "x": 1}'])
def test_what_is_not_a_change_is_refused(body: bytes) -> None:
    with pytest.raises(Refused, match="a change has a mode, and may have a reason"):
        wanted_in(body)


async def test_a_server_that_is_away_is_not_a_lever_that_is_missing() -> None:
    class Away(ForwardingEndpoint):
        async def change_intake(self, change: IntakeChange) -> Intake:
            raise ServerNotFound("no answer")

    async with new_server() as server, serve(Away(server), HTTP) as (url,):
        answer = await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "hold"})
        assert (answer.status, answer.headers["retry-after"]) == (503, "1")


async def test_only_who_may_observe_learns_who_has_paused_an_action_and_its_schedule() -> None:
    may = {Permission.OBSERVE, Permission.OPERATE}

    def authorize(_peer: Peer, _action: str, permission: Permission) -> bool:
        return permission in may

    async with serve(new_server(), HTTP, authorize=authorize) as (url,):
        await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "hold", "reason": "wet floor"})
        [seen] = (await fetch(url, "GET", "/actions")).json
        assert " by 127.0.0.1:" in seen["intake"]["text"]
        assert seen["schedule"] == {"text": "all goals run at once", "max_goals": 20000}
        assert "no_levers" not in seen
        may.remove(Permission.OBSERVE)
        [listed] = (await fetch(url, "GET", "/actions")).json
        assert listed["intake"]["mode"] == "hold"
        assert listed["intake"]["text"].endswith(":00: wet floor")
        assert "127.0.0.1" not in listed["intake"]["text"]
        assert "schedule" not in listed


async def test_an_action_that_cannot_be_paused_says_so_in_its_list_and_refuses_the_lever() -> None:
    class Fixed(ForwardingEndpoint):
        intake = Endpoint.intake
        change_intake = Endpoint.change_intake

    async with new_server() as server, serve(Fixed(server), HTTP) as (url,):
        [listed] = (await fetch(url, "GET", "/actions")).json
        assert listed["no_levers"] == NO_LEVERS
        refused = await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "hold"})
        assert refused.status == 409
        assert refused.json["detail"] == f"the action 'fibonacci' stays as it is: {NO_LEVERS}"


async def test_an_action_that_does_not_tell_how_it_takes_goals_is_listed_all_the_same() -> None:
    class Silent(ForwardingEndpoint):
        async def intake(self) -> Intake:
            raise ServerNotFound("no answer")

    async with new_server() as server, serve(Silent(server), HTTP) as (url,):
        [listed] = (await fetch(url, "GET", "/actions")).json
        assert listed["name"] == "fibonacci"
        assert not listed.keys() & {"away", "intake", "no_levers", "schedule"}
