"""The clients of the simulation, which connect, do the `deeds` of their plans, and leave."""

from __future__ import annotations

import anyio
from anyio import CancelScope, create_task_group, current_time, move_on_after
from anyio.abc import TaskGroup

from fibaction import ActionError, ClientConnection, connect
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Transport
from fibaction.wire.client.connection import RemoteConnection
from tests.simulation.deeds import Deeds
from tests.simulation.goal_names import GoalNames, goal_names
from tests.simulation.invariants import Record
from tests.simulation.loop import EPOCH
from tests.simulation.scenario import ClientPlan, Deed


class Client:
    """One client, from its first connection to its leaving."""

    def __init__(self, record: Record, plan: ClientPlan, transport: Transport) -> None:
        self._record = record
        self.plan = plan
        self.state = record.clients[plan.name]
        self._transport = transport
        self._connection: ClientConnection | None = None
        self.under_way: dict[Deed, float] = {}
        """The deeds that are under way, each with the time of its start."""
        self._scopes: list[CancelScope] = []
        self._left_to_do = len(plan.deeds)
        self._changed = Notifier()
        self.may_leave = anyio.Event()
        self.is_done = False
        """True if all its deeds are done, or it has left."""
        self.has_left = False

    async def run(self) -> None:
        """Connect, do all deeds, and leave after `may_leave` is set."""
        await anyio.sleep(self.plan.starts_at)
        async with create_task_group() as tasks:
            try:
                await self._be_connected(tasks)
            except ActionError as error:
                self._record.failed(self.state, error, "connect")
        self.is_done = True
        self._record.tell(f"{self.plan.name} has left")

    async def _be_connected(self, tasks: TaskGroup) -> None:
        async with connect(self._transport) as connection:
            self._connection = connection
            deeds = Deeds(self._record, self.state, connection)
            for deed in self.plan.deeds:
                tasks.start_soon(self._do, deeds, deed, name=f"{self.plan.name} {deed.kind}")
            with move_on_after(self.plan.leaves_at) as staying:
                await self._until_done()
                self.is_done = True
                await self.may_leave.wait()
            if staying.cancelled_caught:
                await self._stop_deeds(tasks.cancel_scope)
            self.state.is_leaving = True

    def session(self) -> bytes:
        """Return the secret session of its connection; zeros if it has none."""
        if self._connection is None:
            return bytes(16)
        remote = self._connection._connection
        assert isinstance(remote, RemoteConnection)
        return remote._session

    def calls(self) -> list[int]:
        """Return the requests that its connection has under way."""
        if self._connection is None:
            return []
        remote = self._connection._connection
        assert isinstance(remote, RemoteConnection)
        return list(remote.calls._calls)

    async def _stop_deeds(self, everything: CancelScope) -> None:
        """Leave early, in one of three ways: end the deeds before the connection, or by closing the
        connection, or both at once.
        """
        way = int(self.plan.leaves_at * 1e6) % 3
        self._record.tell(f"{self.plan.name} leaves early: {way}")
        for goal_id in self.state.goals:
            self._record.may_cancel(goal_id)
        if way == 0:
            for scope in self._scopes:
                scope.cancel()
            await self._until_done()
        elif way == 1:
            self.state.is_leaving = True
            everything.cancel()

    async def _until_done(self) -> None:
        while self._left_to_do:
            await self._changed.wait()

    async def _do(self, deeds: Deeds, deed: Deed) -> None:
        record, name = self._record, self.plan.name
        with CancelScope() as scope:
            self._scopes.append(scope)
            await anyio.sleep(deed.at)
            scope.deadline = current_time() + deed.patience
            self.under_way[deed] = current_time()
            mine = GoalNames(record, name, deed)
            goal_names.set(mine)
            record.tell(f"{name} begins: {deed.kind}")
            try:
                await deeds.do(deed)
            except ActionError as error:
                since = self.under_way[deed] - EPOCH
                record.failed(self.state, error, deed.kind, mine.goal_id, since=since)
        self.under_way.pop(deed, None)
        self._left_to_do -= 1
        self._changed.notify()
        record.tell(
            f"{name} {'was canceled' if scope.cancelled_caught else 'is done'}: {deed.kind}"
        )
