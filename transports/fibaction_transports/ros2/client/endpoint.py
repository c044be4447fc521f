"""The client's half of the transport: endpoints whose servers are action servers of ROS."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext
from typing import Any, TypeAlias, TypeVar

import anyio
from anyio import current_time
from anyio.abc import TaskGroup

from fibaction.border.abc import Connection, Endpoint, GoalRequest
from fibaction.border.event_loop import Background
from fibaction.border.peer_text import clean_logger, shortened
from fibaction.feeds.status_broadcast import StatusSubscription
from fibaction.schema.goal_check import GoalCheck
from fibaction.types.action import EMPTY_MAP, NIL, Action, ActionInfo
from fibaction.words.errors import (
    ConnectionLost,
    GoalRejected,
    ProtocolError,
    RejectionCode,
    TransportError,
)
from fibaction.words.goals import (
    UNKNOWN_OUTCOME,
    ActionPeers,
    CancelAnswer,
    CancelCode,
    GoalID,
    GoalInfo,
    Outcome,
)
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2.client.action_client import RosActionClient
from fibaction_transports.ros2.client.diagnosis import explain_versions
from fibaction_transports.ros2.client.goal_stream import GoalDecoder, RosGoalStream
from fibaction_transports.ros2.convert.conversion import RosAction, RosCodecs, goal_id_of, stamp_of
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node.parts import FEEDBACK, EndInfo, GraphView
from fibaction_transports.ros2.node.ros_node import EndpointInRos, RosNode, RosTypes
from fibaction_transports.ros2.node.stamps import FIRST_STAMP, LAST_STAMP
from fibaction_transports.ros2.settings import RosSettings

GRAPH_PAUSE = 0.02
"""Seconds between two looks at the graph."""
GROWN = 5.0
"""Seconds after which a node has found the others: each announces itself again within 3 s."""
LONGEST = 4.0
"""Seconds that a look takes at most, if something is found and there is always news."""

FoundT = TypeVar("FoundT")
Hints: TypeAlias = Callable[[], Awaitable[list[str]]]


class GraphLooks:
    """Looks of a connection at the graph of its node, which wait until discovery is complete.

    A node that has just begun knows nothing of the graph, and finds the others one by one. So a
    look is complete

    - if no participant is known whose ends have not come yet, and
    - if there was no news for a quiet time, which the middleware says: see `DiscoveryState`; and
    - if something was found. That there is nothing is said only after `discovery_timeout` seconds.

    A node that has been there for long has found the others: a look at it takes no time, unless a
    participant has just come. With rclpy, which does not tell what is missing, a new node has a
    scout next to it (`on_dds.graph.open_scout`).
    """

    def __init__(self, ros: RosNode, discovery_timeout: float) -> None:
        self._ros = ros
        self._opened = current_time()
        self._timeout = discovery_timeout

    async def settled(self, look: Callable[[GraphView], FoundT]) -> FoundT:
        """Return what is found in the graph when discovery is complete.

        Raises:
            ConnectionLost: ROS has been shut down.
        """
        self._ros.raise_if_lost()
        began = current_time()
        async with self._view() as view:
            found, state = self.once(look, view), view.discovery()
            changed = current_time()  # not before: on a busy machine, a scout takes a second
            while not self._is_over(bool(found), began):
                is_quiet = self._is_grown() or current_time() - changed >= state.quiet
                if found and is_quiet and not state.pending:
                    break
                await anyio.sleep(GRAPH_PAUSE)
                before = state
                found, state = self.once(look, view), view.discovery()
                if state != before:
                    changed = current_time()
        return found

    def once(self, look: Callable[[GraphView], FoundT], view: GraphView | None = None) -> FoundT:
        """Return what is found in the graph now.

        Raises:
            ConnectionLost: ROS has been shut down.
        """
        self._ros.raise_if_lost()
        found = look(view or self._ros)
        self._ros.raise_if_lost()
        return found

    def _is_over(self, is_found: bool, began: float) -> bool:
        since, most = (began, LONGEST) if is_found else (self._opened, self._timeout)
        return current_time() - since >= most

    def _view(self) -> AbstractAsyncContextManager[GraphView]:
        return nullcontext(self._ros) if self._is_grown() else self._ros.observed()

    def _is_grown(self) -> bool:
        return current_time() - self._opened >= GROWN


logger = clean_logger("fibaction.ros2")

_ENDS = frozenset(status for status in GoalStatus if status.is_terminal)


class RosEndpoint(EndpointInRos):
    """An action of ROS, with the types of its user."""

    def __init__(
        self, client: RosActionClient, info: ActionInfo, ros_action: RosAction, codecs: RosCodecs
    ) -> None:
        self.ros_action = ros_action
        self._client = client
        self._info = info
        self._codecs = codecs
        self._decoder = _Decoder(client.types, client.impl, codecs)
        self._check = GoalCheck(lambda: info.goal)

    @property
    def info(self) -> ActionInfo:
        return self._info

    async def offer_goal(self, request: GoalRequest) -> RosGoalStream:
        """See `Endpoint.offer_goal`. A request of ROS cannot carry a deadline and a meta."""
        goal_id, depth = request.goal_id, self._client.depth
        try:
            goal = EMPTY_MAP if request.goal == NIL else request.goal
            message = self._codecs.goal.to_ros(goal)
        except ProtocolError as exc:
            raise await self._rejection(request, str(exc)) from exc
        stream = RosGoalStream(goal_id, self._decoder, depth, reads=request.feedback)
        await self._client.send(stream, message)
        return stream

    async def _rejection(self, request: GoalRequest, misread: str) -> GoalRejected:
        """Return the rejection of a goal that is not of the type, with the text of other doors."""
        try:
            checking = self._check.check(request.goal, misread)
            assert checking is not None  # a small goal is rejected at once
            await checking
        except GoalRejected as exc:
            misread = exc.reason
        code = RejectionCode.UNREADABLE
        return GoalRejected(shortened(misread), goal_id=request.goal_id, code=code)

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> RosGoalStream:
        """See `Endpoint.feedback`. ROS remembers no feedback, so `after` and `attempt` have no
        effect.
        """
        stream = RosGoalStream(goal_id, self._decoder, self._client.depth, reads=True)
        await self._client.follow(stream)
        return stream

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        request = self._client.impl.CancelGoalService.Request()
        info = request.goal_info
        info.goal_id.uuid = self._client.types.uuid(goal_id or bytes(16))
        # A stamp beyond these would silently become another one, or none, which means all goals.
        known = self._client.stamps
        within = min(max(known.to_ros(stamp) if stamp else 0, FIRST_STAMP), LAST_STAMP)
        info.stamp.sec, info.stamp.nanosec = divmod(within, 10**9)
        response = await self._client.cancel(request)
        canceling = tuple(
            GoalInfo(
                goal_id_of(one.goal_id),
                known.from_ros(goal_id_of(one.goal_id), stamp_of(one.stamp)),
                GoalStatus.CANCELING,
            )
            for one in response.goals_canceling
        )
        try:
            code = CancelCode(response.return_code)
        except ValueError as exc:
            raise ProtocolError(f"invalid answer to a cancel: {exc}") from exc
        if goal_id is not None and not stamp and not canceling and code is CancelCode.NONE:
            code = CancelCode.REJECTED  # servers of rclpy cannot say it in another way
        return CancelAnswer(code, canceling)

    async def status(self) -> StatusSubscription:
        return await self._client.subscribe()

    async def wait_for_server(self) -> None:
        await self._client.presence.come()


class _Decoder(GoalDecoder):
    """Decodes with the codecs of an endpoint."""

    def __init__(self, types: RosTypes, impl: Any, codecs: RosCodecs) -> None:
        self._types = types
        self._impl = impl
        self._codecs = codecs
        self._empty = codecs.result.from_ros(codecs.result.to_ros(None))

    def feedback(self, message: bytes) -> bytes:
        try:
            found = self._types.decode(message, self._impl.FeedbackMessage)
        except ProtocolError as exc:
            raise ProtocolError(f"invalid feedback of {len(message)} bytes: {exc}") from exc
        return self._codecs.feedback.from_ros(found.feedback)

    def outcome(self, response: Any) -> Outcome[bytes]:
        if response.status == GoalStatus.UNKNOWN:
            return UNKNOWN_OUTCOME
        if response.status not in _ENDS:
            raise ProtocolError(f"invalid answer with a result: its status is {response.status}")
        status = GoalStatus(response.status)
        result: bytes | None = self._codecs.result.from_ros(response.result)
        if status is not GoalStatus.SUCCEEDED and result == self._empty:
            result = None  # ROS cannot send "no result"
        return Outcome(status, result)


class RosConnection(Connection):
    """A connection to all actions in the graph of a node."""

    def __init__(
        self, ros: RosNode, tasks: TaskGroup, settings: RosSettings, hints: Hints | None
    ) -> None:
        """`hints` returns why nodes may be elsewhere."""
        self._ros = ros
        self._hints = hints
        self._tasks = tasks
        self._settings = settings
        self._looks = GraphLooks(ros, settings.discovery_timeout)
        self._clients: dict[tuple[str, str], RosActionClient] = {}
        self._seen: dict[str, str] = {}
        """The actions whose servers have other versions of the types, by what is to be told."""

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        """See `Connection.endpoint`.

        Raises:
            TransportError: The type of the action is not known in ROS, or does not match.
        """
        info = action.info if isinstance(action, Action) else action
        full = action_names(self._ros.resolve, info.name)
        served = {} if info.type_name else dict(self._looks.once(GraphView.served_actions))
        type_name = info.type_name or served.get(full.feedback, "")
        found = self._ros.types.find_to_follow(type_name, info.name)
        codecs = found.codecs(info)
        client = self._clients.get((full.feedback, type_name))
        if client is None or client.impl is not found.impl:
            client = RosActionClient(self._ros, info.name, found.impl, self._settings)
            self._clients[full.feedback, type_name] = client
            self._tasks.start_soon(client.run, name=f"client of {info.name}")
        return RosEndpoint(client, info, found, codecs)

    async def actions(self) -> list[ActionInfo]:
        """See `Connection.actions`. Actions whose types are not installed here have no schemas,
        but for what their servers tell of them. The log says which have other versions there.
        """
        found = await self._looks.settled(GraphView.served_actions)
        await self._ros.learn(found)
        self._ros.raise_if_lost()
        named = [(self._relative(topic), type_name) for topic, type_name in found]
        infos = [_described(self._ros.types, *one) for one in named]
        for info in infos:
            self._warn_of_versions(info)
        if not infos:
            await self._tell_hints()
        return infos

    async def _tell_hints(self) -> None:
        """Log once why there may be no action here."""
        hints, self._hints = self._hints, None
        if hints is not None:
            trouble = (await self._ros.links()).trouble
            new = [trouble] if trouble and trouble not in self._ros.told else []
            for hint in [*new, *await hints()]:
                logger.warning("no action was found: %s", hint)

    async def interface_texts(self, action: ActionInfo) -> dict[str, str]:
        """See `Connection.interface_texts`. They are those of the version that the server has."""
        full = action_names(self._ros.resolve, action.name)
        await self._ros.learn([(full.feedback, action.type_name)])
        self._ros.raise_if_lost()
        texts = self._ros.types.texts(action.type_name)
        if problem := self._version_problem(action):
            self._ros.told.add(problem)
            raise TransportError(problem)
        return texts

    def _version_problem(self, info: ActionInfo) -> str:
        full = action_names(self._ros.resolve, info.name)
        return explain_versions(self._ros, full, self._ros.types.find(info.type_name).impl)

    def _warn_of_versions(self, info: ActionInfo) -> None:
        """Log once that a server has other versions of the types than this end.

        It is logged at the second look, or at the end: after the first look, a goal may be sent,
        whose error says so.
        """
        if not info.feedback:
            return  # there are no types here
        problem = self._version_problem(info)
        if problem in self._seen:
            self._tell(problem)
        elif problem:
            self._seen[problem] = info.name

    def _tell(self, problem: str) -> None:
        if problem not in self._ros.told:
            self._ros.told.add(problem)
            logger.warning("%s cannot be used: %s", self._seen[problem], problem)

    async def peers(self, action: str) -> ActionPeers:
        """See `Connection.peers`. Peers are named by their nodes. The clients are the nodes that
        subscribe to the feedback, as every client of an action does.
        """

        def look(view: GraphView) -> ActionPeers | None:
            full = action_names(self._ros.resolve, action)
            servers = _nodes(view.publishers(full.status))
            clients = _nodes(view.subscriptions(full.feedback))
            return ActionPeers(servers, clients) if servers or clients else None

        return await self._looks.settled(look) or ActionPeers()

    async def nodes(self) -> set[str]:
        found = await self._looks.settled(lambda view: view.nodes())
        return found - {self._ros.full_name}

    def _relative(self, topic: str) -> str:
        """Return the shortest name of the action in the node's namespace."""
        name = topic.removesuffix(FEEDBACK)
        short = name.removeprefix(self._ros.namespace.rstrip("/") + "/")
        same = action_names(self._ros.resolve, short).feedback == topic
        return short if same else name

    def close(self) -> None:
        """End everything that is pending, and everything that is tried later."""
        for problem in self._seen:
            self._tell(problem)
        self._ros.fail(ConnectionLost("the connection was closed here"))


def _described(types: RosTypes, name: str, type_name: str) -> ActionInfo:
    try:
        return types.find(type_name).info(name)
    except TransportError:
        return ActionInfo(name, type_name)


def _nodes(ends: Iterable[EndInfo]) -> tuple[str, ...]:
    """Return the full names of the nodes of these ends of a topic. Ends whose nodes are not yet
    discovered are left out.
    """
    return tuple(sorted({one.node for one in ends if one.node}))


@asynccontextmanager
async def connect_actions(
    ros: RosNode, settings: RosSettings, hints: Hints | None = None
) -> AsyncGenerator[RosConnection, None]:
    """Connect for as long as the block lasts. `hints` returns why nodes may be elsewhere."""
    async with Background() as tasks:
        connection = RosConnection(ros, tasks, settings, hints)
        try:
            yield connection
        finally:
            connection.close()
