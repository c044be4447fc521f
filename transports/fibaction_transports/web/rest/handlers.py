"""The REST interface: what each request does, at the endpoints.

A request is one of a client like those of the wire protocol: it has a token, a name, and
permissions. A client with a token is the same client in each of its requests; a client without one
is another client each time, so it observes a goal that it sends again.

The ID of a goal that is posted with a key is made of the key, the client's name and a secret of
this process: who sees the ID learns nothing of the client's token.

A goal whose stream of events is the answer to the request that sent it ends with that answer: if
the client goes, the goal is canceled, as if it had left the block of `send_goal`. One that was
posted with a key keeps running, since the client can come back with the key, as all other goals do.
"""

from __future__ import annotations

import secrets
from datetime import UTC, datetime
from functools import partial
from hashlib import blake2b
from time import time_ns

import anyio
import msgspec

from fibaction.border.abc import Endpoint, cancel_each
from fibaction.border.http_access import Refused, bearer_in
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.border.streams import GoalStream
from fibaction.feeds.answers import statuses_soon
from fibaction.schema.payload import GoalCodec, JsonCodec
from fibaction.schema.turns import Pause, in_turn, read_json
from fibaction.types.action import ActionInfo
from fibaction.wire.auth import Permission
from fibaction.wire.messages import VERSION, Hello
from fibaction.wire.server.session_client import SessionClient
from fibaction.wire.wire_server import WireServer
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    CancelRejected,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)
from fibaction.words.goal_query import cancel_stamp_of
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID
from fibaction.words.meta import trace_meta, with_labels
from fibaction_transports._http.exchange import Exchange, tag_of
from fibaction_transports.web.rest.actions import (
    LARGEST_CHANGE,
    ONE_DAY,
    KnownStatistics,
    all_described,
    wanted_in,
)
from fibaction_transports.web.rest.goal_events import (
    LONGEST_WAIT,
    Cursor,
    GoalEvents,
    cursor_of,
    tell_goal,
    wait_for_end,
)
from fibaction_transports.web.rest.goal_list import (
    chosen,
    facts_of,
    found_by,
    labels_in,
    listed,
    members_of,
    page_of,
    past_of,
    refusing,
    search_of,
)
from fibaction_transports.web.rest.openapi import describe
from fibaction_transports.web.rest.routes import (
    FILTERS,
    Resource,
    Route,
    allowed_at,
    check_parameters,
    route_of,
)

KEY_HEADER = "idempotency-key"
"""The header with which a goal that is posted again is the same goal."""
CANCEL_TIMEOUT = 5.0
"""Seconds for the cancel of a goal whose client has gone."""

logger = clean_logger("fibaction.web")


class RestInterface:
    """The requests of all clients, as they concern the endpoints of one server."""

    def __init__(self, server: WireServer) -> None:
        self._endpoints = server.endpoints
        self._settings = server.settings
        self._memory = server.memory
        self._turn = server.turn
        self._codecs: dict[str, tuple[ActionInfo, GoalCodec]] = {}
        self._statistics = KnownStatistics()
        self._secret = secrets.token_bytes()  # of the keys of goals
        self._has_tokens = server.settings.access.asks_for_tokens
        self._handlers = {
            (Resource.DESCRIPTION, "GET"): self._describe,
            (Resource.ACTIONS, "GET"): self._list_actions,
            (Resource.ACTION, "GET"): self._get_action,
            (Resource.STATISTICS, "GET"): self._tell_statistics,
            (Resource.INTAKE, "GET"): self._tell_intake,
            (Resource.INTAKE, "PUT"): self._change_intake,
            (Resource.GOALS, "GET"): self._list_goals,
            (Resource.GOALS, "POST"): self._send_goal,
            (Resource.GOALS, "DELETE"): self._cancel_goals,
            (Resource.GOAL, "GET"): self._get_goal,
            (Resource.GOAL, "PUT"): self._send_goal,
            (Resource.GOAL, "DELETE"): self._cancel_goal,
            (Resource.EVENTS, "GET"): self._follow_goal,
            (Resource.RERUN, "POST"): self._rerun_goal,
            (Resource.LOG, "GET"): self._tell_log,
            (Resource.SEARCH, "GET"): self._search_goals,
        }

    async def handle(self, exchange: Exchange) -> None:
        """Answer one request.

        Raises:
            Refused, PayloadError: The request is wrong.
            ActionError: It cannot be answered.
        """
        client = self.admit(exchange)
        method = "GET" if exchange.method == "HEAD" else exchange.method
        route = route_of(method, exchange.path, self._endpoints)
        check_parameters(exchange.query, route, method)
        await self._handlers[route.resource, method](exchange, client, route)

    def allowed_at(self, path: str) -> str:
        """Return the methods of what is at a path.

        Raises:
            Refused: Nothing is there.
        """
        return allowed_at(path, self._endpoints)

    def admit(self, exchange: Exchange) -> SessionClient:
        """Return the client, if it has a token where one is asked for.

        Raises:
            Refused: It does not.
        """
        token = bearer_in(exchange.headers) if self._has_tokens else ""
        session = blake2b(token.encode(), digest_size=16).digest() if token else b""
        client = SessionClient(exchange.peer, self._endpoints, self._settings)
        try:
            client.greet(Hello(VERSION, 1, token, session))
        except AuthenticationFailed as exc:
            raise Refused(401, str(exc), ("WWW-Authenticate", "Bearer")) from None
        return client

    async def _endpoint(
        self, client: SessionClient, route: Route, permission: Permission
    ) -> Endpoint:
        """Return the endpoint that a request is about, if the client has the permission.

        Raises:
            AuthenticationFailed: It does not have it.
            Refused: The action is not served here.
            ServerNotFound: Its server is away.
        """
        try:
            endpoint = await client.endpoint(route.action, permission)
        except ServerNotFound as exc:
            raise Refused(404, str(exc)) from None
        if (absence := endpoint.absence) is not None and route.resource is not Resource.ACTION:
            since = datetime.fromtimestamp(absence.since, UTC).isoformat(timespec="seconds")
            raise ServerNotFound(f"the server is away since {since}: {absence.reason}")
        return endpoint

    async def _own_or_observed(self, client: SessionClient, route: Route) -> Endpoint:
        """Return the endpoint of a goal that the client may follow."""
        own = client.is_owner(route.action, route.goal_id)
        return await self._endpoint(client, route, Permission.SEND if own else Permission.OBSERVE)

    # Actions

    async def _describe(self, exchange: Exchange, _client: SessionClient, _route: Route) -> None:
        infos = [endpoint.info for endpoint in self._endpoints.values()]
        described = describe(infos, exchange.root, asks_for_tokens=self._has_tokens)
        body = msgspec.json.encode(described)
        await exchange.answer_unless_known(body, tag_of(body))

    async def _list_actions(self, exchange: Exchange, client: SessionClient, _route: Route) -> None:
        described = await all_described(self._endpoints.values(), client.may_observe)
        await exchange.answer(200, msgspec.json.encode(described))

    async def _get_action(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        endpoint = await self._endpoint(client, route, Permission.OBSERVE)
        [described] = await all_described([endpoint], client.may_observe)
        await exchange.answer(200, msgspec.json.encode(described))

    async def _tell_statistics(
        self, exchange: Exchange, client: SessionClient, route: Route
    ) -> None:
        endpoint = await self._endpoint(client, route, Permission.OBSERVE)
        since = exchange.parameter("since")
        told = await self._statistics.of(endpoint, ONE_DAY if since is None else since)
        await exchange.answer(200, told)

    async def _tell_intake(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        endpoint = await self._endpoint(client, route, Permission.OBSERVE)
        await exchange.answer(200, msgspec.json.encode(await endpoint.intake()))

    async def _change_intake(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        endpoint = await self._endpoint(client, route, Permission.OPERATE)
        wanted = wanted_in(await exchange.json_body(LARGEST_CHANGE, self._memory))
        change = client.change_of(wanted.mode, wanted.reason, worker=wanted.worker)
        try:
            intake = await endpoint.change_intake(change)
        except TransportError as exc:
            if type(exc) is not TransportError:  # its server is away, for example
                raise
            raise Refused(409, str(exc)) from None  # it has not this lever
        await exchange.answer(200, msgspec.json.encode(intake))

    # Goals

    async def _list_goals(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        endpoint = await self._endpoint(client, route, Permission.OBSERVE)
        page = page_of(exchange.query, time_ns())
        with await statuses_soon(endpoint) as statuses:
            # Afterwards, so that a goal which is forgotten meanwhile is in one of them.
            past = await past_of(endpoint, page)
            body, cursor = await listed(statuses, page, self._turn, past)
        next_page = ("Link", f'<{page.next_query(cursor)}>; rel="next"')
        await exchange.answer(200, body, *([next_page] if cursor else ()))

    async def _search_goals(self, exchange: Exchange, client: SessionClient, _route: Route) -> None:
        search = search_of(exchange.query, time_ns())
        if unknown := search.actions - self._endpoints.keys():
            raise Refused(404, f"there is no action {excerpt(min(unknown))!r}")
        endpoints: list[Endpoint] = []
        for name in search.actions or list(self._endpoints):
            try:
                endpoints.append(await client.endpoint(name, Permission.OBSERVE))
            except AuthenticationFailed:
                if search.actions:
                    raise
        await exchange.answer(200, await found_by(search.goals, endpoints))

    async def _send_goal(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        key = exchange.headers.get(KEY_HEADER, "")
        if exchange.method == "POST":
            goal_id = self._goal_id_of(client, route.action, key) if key else GoalID.random()
            route = Route(Resource.GOAL, route.action, goal_id)
        endpoint = await self._endpoint(client, route, Permission.SEND)
        wait = exchange.wait_wanted(LONGEST_WAIT)
        streams = exchange.wants_events
        is_detached = wait is None and not streams
        labels = dict(labels_in(exchange.query))
        body = await exchange.json_body(self._settings.limits.frame, self._memory)
        payload = await in_turn(len(body), partial(_payload, self._goal_codec(endpoint.info), body))
        is_known = bool(endpoint.owner_of(route.goal_id))
        stream = await endpoint.send_goal(
            route.goal_id,
            payload,
            feedback=streams,
            sender=client.sender,
            meta=with_labels(labels, trace_meta(exchange.headers, is_detached=is_detached)),
            checked=True,
        )
        with stream:
            own = stream.own and self._may_own(exchange, client, route)
            if not own:
                stream.hold(False)
                await self._endpoint(client, route, Permission.OBSERVE)
            status = 200 if is_known else 201
            location = ("Location", f"{exchange.root}/actions/{route.action}/goals/{route.goal_id}")
            if streams:
                events = _events_of(endpoint)
                told = await tell_goal(exchange, events, stream, status, location)
                if own and not told and not key:
                    await self._cancel_cut(exchange, client, route)
                return
            await self._answer_goal(exchange, endpoint, stream, wait, status, location)

    def _goal_id_of(self, client: SessionClient, action: str, key: str) -> GoalID:
        """Return the ID of the goal that is posted with a key: the same for the same client."""
        parts = msgspec.json.encode([client.sender.name, action, key])
        return GoalID(blake2b(parts, key=self._secret, digest_size=16).digest())

    def _may_own(self, exchange: Exchange, client: SessionClient, route: Route) -> bool:
        """Return whether a goal that its endpoint takes for this client's can be that.

        A gateway is one client for all of its clients, so its server cannot tell them apart. A
        client that is not permitted everything, and gives an ID of its own, is one of them.
        """
        is_new = exchange.method == "POST" and KEY_HEADER not in exchange.headers
        return is_new or client.is_trusted or client.is_owner(route.action, route.goal_id)

    def _goal_codec(self, info: ActionInfo) -> GoalCodec:
        known, codec = self._codecs.get(info.name, (None, None))
        if codec is None or known is not info:
            codec = GoalCodec(info.goal)
            self._codecs[info.name] = info, codec
        return codec

    async def _cancel_cut(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        """Cancel a goal whose client has gone."""
        with anyio.move_on_after(CANCEL_TIMEOUT, shield=True):
            try:
                endpoint = await self._endpoint(client, route, Permission.CANCEL)
                await endpoint.cancel_goals(route.goal_id)
            except ActionError as exc:
                logger.warning(
                    "%s has gone, and goal %s runs on: %s", exchange.peer, route.goal_id, exc
                )

    async def _answer_goal(
        self,
        exchange: Exchange,
        endpoint: Endpoint,
        stream: GoalStream,
        wait: float | None,
        status: int,
        *headers: tuple[str, str],
        checkpoint: bytes | None = None,
    ) -> None:
        """Answer with the state of a goal, after waiting for its end if that is asked for."""
        if wait is None:
            outcome = stream.known_outcome()
        else:
            outcome = await wait_for_end(exchange, stream, wait)
        members = facts_of(stream.info)
        if outcome is not None:
            events = _events_of(endpoint)
            members |= events.outcome_members(outcome) | events.checkpoint_members(checkpoint)
        await exchange.answer(status, msgspec.json.encode(members), *headers)

    async def _get_goal(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        wait = exchange.wait_wanted(LONGEST_WAIT)
        endpoint = await self._own_or_observed(client, route)
        with await endpoint.feedback(route.goal_id) as stream:
            checkpoint = stream.checkpoint
            if checkpoint is not None and not await client.may_observe(route.action):
                checkpoint = None
            await self._answer_goal(exchange, endpoint, stream, wait, 200, checkpoint=checkpoint)

    async def _follow_goal(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        last = exchange.headers.get("last-event-id") or exchange.parameter("after")
        cursor = Cursor() if last is None else cursor_of(last)
        times = exchange.parameter("times")
        if times not in (None, "true", "false"):
            raise Refused(400, "times is true or false")
        endpoint = await self._own_or_observed(client, route)
        if cursor is None:
            await exchange.answer(204, b"")  # a browser comes back after the end, too
            return
        stream = await endpoint.feedback(route.goal_id, after=cursor.number, attempt=cursor.attempt)
        with stream:
            if exchange.method == "HEAD":
                exchange.begin_events(200)
                await exchange.end()
                return
            events = _events_of(endpoint, has_times=times == "true")
            await tell_goal(exchange, events, stream, 200)

    async def _rerun_goal(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        endpoint = await self._endpoint(client, route, Permission.OPERATE)
        new = await endpoint.rerun(route.goal_id)
        if new is None:
            text = f"goal {route.goal_id} was not given up, is not kept any more, or runs again"
            raise Refused(409, text)
        location = ("Location", f"{exchange.root}/actions/{route.action}/goals/{new}")
        await exchange.answer(201, msgspec.json.encode({"goal_id": str(new)}), location)

    async def _tell_log(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        endpoint = await self._endpoint(client, route, Permission.OBSERVE)
        lines = await endpoint.log_lines(route.goal_id)
        told = None
        if lines is not None:
            told = [{**msgspec.structs.asdict(line), "at": str(line.at)} for line in lines]
        await exchange.answer(200, msgspec.json.encode({"lines": told}))

    # Cancels

    async def _cancel_goal(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        endpoint = await self._endpoint(client, route, Permission.CANCEL)
        answer = await endpoint.cancel_goals(route.goal_id)
        if answer.return_code is CancelCode.UNKNOWN_GOAL_ID:
            raise UnknownGoal(route.goal_id)
        await self._answer_cancel(exchange, answer)

    async def _cancel_goals(self, exchange: Exchange, client: SessionClient, route: Route) -> None:
        before, stamp = exchange.parameter("before"), None
        if before is not None:
            with refusing("before"):
                stamp = cancel_stamp_of(before, time_ns(), is_local=False)
        endpoint = await self._endpoint(client, route, Permission.CANCEL)
        if exchange.query.keys().isdisjoint(FILTERS):
            answer = await endpoint.cancel_goals(None, stamp)
        else:
            # Who may not see the goals cannot ask by a filter what they are.
            await self._endpoint(client, route, Permission.OBSERVE)
            page = page_of(exchange.query, time_ns())
            with await statuses_soon(endpoint) as statuses:
                infos = await chosen(statuses, page, self._turn)
            active = (info for info in infos if info.status.is_active)
            answer = await cancel_each(
                endpoint,
                [info.goal_id for info in active if stamp is None or info.stamp <= stamp],
            )
        await self._answer_cancel(exchange, answer)

    async def _answer_cancel(self, exchange: Exchange, answer: CancelAnswer) -> None:
        if answer.return_code is CancelCode.REJECTED:
            raise CancelRejected(answer.reason)
        if answer.return_code is not CancelCode.NONE:
            raise CancelRejected("the goal has ended")
        members = {
            "code": answer.return_code.name,
            "goals_canceling": [members_of(info) for info in answer.goals_canceling],
            "reason": answer.reason,
        }
        await exchange.answer(202, msgspec.json.encode(members))


def _events_of(endpoint: Endpoint, *, has_times: bool = False) -> GoalEvents:
    result = JsonCodec({}, f"result of {endpoint.info.name!r}")
    return GoalEvents(JsonCodec({}, "feedback"), result, has_times)


def _payload(codec: JsonCodec, body: bytes, pause: Pause | None) -> bytes:
    """Return the payload of the goal in a body; an empty one is `{}`.

    Raises:
        Refused: It is not JSON.
        PayloadError: It is not a goal.
    """
    try:
        data = read_json(body or b"{}")
    except (ValueError, RecursionError) as exc:
        raise Refused(400, f"the body is not JSON: {exc}") from None
    return codec.encode(data, is_json=True, pause=pause)
