"""`.../intake`: how an action takes goals, told and changed by REST."""

from __future__ import annotations

import anyio
import pytest

from fibaction import Peer, Permission, ServerNotFound, connect, serve
from fibaction.border.abc import ForwardingEndpoint, Intake, IntakeChange
from fibaction.border.http_access import Refused
from fibaction_transports.web.rest.intakes import wanted_in
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
        assert (await fetch(url, "GET", f"{ACTION}/intake")).json == {"mode": "open", "changes": []}


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
