"""The hostile clients of the simulation, which know the protocol, and use it against the server.

A hostile client does the attacks of its plan, one after another, with the messages themselves and
not with fibaction's client. An attack is the method of its name. Where the server has closed its
connection, it opens another one. Its `wires` check what it is answered.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from itertools import count

import anyio
from anyio import current_time, move_on_after
from anyio.abc import TaskGroup

from fibaction import GoalID
from fibaction.wire.auth import Permission
from fibaction.wire.frames import MAX_FRAME, header
from fibaction.wire.messages import (
    VERSION,
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelGoals,
    Close,
    Credit,
    Follow,
    FromClient,
    Goodbye,
    Hello,
    ListActions,
    Received,
    SendGoal,
    WatchStatus,
    Welcome,
    encode,
)
from tests.simulation.facts import HOSTILE_TOKEN
from tests.simulation.invariants import Record
from tests.simulation.network import Line
from tests.simulation.scenario import SIMULATED, Attack, HostilePlan, Work
from tests.simulation.wires import GONE, Wire

PATIENCE = 20.0
"""Seconds that one attack may take: the server may not read on."""
SETTLE = 300.0
"""Seconds within which all requests are answered, or the connection ends."""
FORGED = "one line\n2026-01-01 00:00:00 fibaction.wire: another\r\x1b[2J\x1b]0;title\x07\u202e" * 9
"""A text that would write lines of its own into a log, and act on a terminal."""


class Hostile:
    """One hostile client, from its start to its leaving."""

    def __init__(
        self,
        record: Record,
        plan: HostilePlan,
        line: Line,
        session_of: Callable[[int], bytes],
    ) -> None:
        """Let `session_of` return the session of an honest client."""
        self.plan = plan
        self._record = record
        self._line = line
        self._session_of = session_of
        self._chance = random.Random(f"{plan.name} {record.scenario.seed}")
        self._session = self._chance.randbytes(16) if plan.has_session else b""
        self._ids = count(1)
        self._wire: Wire | None = None
        self._wires: list[Wire] = []
        self._tasks: TaskGroup
        self.may_leave = anyio.Event()
        self.is_done = False
        self.has_left = False

    async def run(self) -> None:
        """Do all attacks, wait for their answers, and leave after `may_leave` is set."""
        await anyio.sleep(self.plan.starts_at)
        begun = current_time()
        async with anyio.create_task_group() as self._tasks:
            for attack in self.plan.attacks:
                await anyio.sleep_until(begun + attack.at)
                self._record.tell(f"ATTACK {self.plan.name} {attack.kind} x{attack.count}")
                with move_on_after(PATIENCE):
                    try:
                        await getattr(self, f"_{attack.kind.replace(' ', '_')}")(attack)
                    except GONE as error:
                        self._record.tell(f"{self.plan.name} was ended: {type(error).__name__}")
            await self._settle()
            self.is_done = True
            await self.may_leave.wait()
            await self._leave()
        self.has_left = True

    async def _settle(self) -> None:
        """Wait until every request was answered, or its connection has ended."""
        if self.plan.reads == "never":
            return
        for wire in self._wires:
            with move_on_after(SETTLE):
                await wire.settled()
        for wire in self._wires:
            if wire.is_open and wire.unanswered and not wire.is_cut_short:
                left = sorted({type(one).__name__ for one in wire.unanswered.values()})
                self._record.fail("hostile", f"{self.plan.name} has no answer to {left}")

    async def _leave(self) -> None:
        for wire in self._wires:
            await wire.leave(self.plan.leaves)
        if self.plan.leaves == "silence":
            self._line.cut("silence")
        self._tasks.cancel_scope.cancel()

    # Connections

    async def _connected(self) -> Wire:
        """Return the open connection, after a new one if there was none."""
        if self._wire is None or not self._wire.is_open or self._wire.is_cut_short:
            self._wire = await self._dial()
            await self._wire.send(self._hello())
        return self._wire

    async def _dial(self, *, heartbeats: bool = True) -> Wire:
        wire = Wire(self._record, self.plan, await self._line.dial())
        self._wires.append(wire)
        self._tasks.start_soon(wire.run, heartbeats and self.plan.reads != "never")
        return wire

    def _hello(self, session: bytes | None = None) -> Hello:
        plan = self.plan
        token = HOSTILE_TOKEN if plan.has_token else self._chance.choice(["", "a guess"])
        session = self._session if session is None else session
        return Hello(VERSION, plan.heartbeat, token, session, plan.max_frame)

    async def _all(self, messages: Iterable[FromClient]) -> None:
        wire = await self._connected()
        for message in messages:
            await wire.send(message)

    def _others_goals(self, attack: Attack) -> list[tuple[GoalID, Work]]:
        """Return the goals of honest clients that an attack is about."""
        # An ID is its client's secret until the server has the goal.
        sent = [one for one in self._record.sent if self._record.truth(one[0], None) is not None]
        sent = sent or [(GoalID(self._chance.randbytes(16)), attack.work)]
        return [sent[(attack.target + index) % len(sent)] for index in range(attack.count)]

    # Goals

    async def _send(self, attack: Attack) -> None:
        goal = SIMULATED.goal.encode(attack.work)
        for _ in range(attack.count):
            goal_id = self._chance.randbytes(16)
            await self._all([self._sending(goal_id, goal, attack)])

    def _sending(self, goal_id: bytes, goal: bytes, attack: Attack) -> SendGoal:
        return SendGoal(next(self._ids), SIMULATED.name, goal_id, goal, attack.credit)

    async def _send_again(self, attack: Attack) -> None:
        goal_id, goal = self._chance.randbytes(16), SIMULATED.goal.encode(attack.work)
        self._record.copied.add(GoalID(goal_id))
        await self._all(self._sending(goal_id, goal, attack) for _ in range(attack.count))

    async def _copy(self, attack: Attack) -> None:
        for goal_id, work in self._others_goals(attack):
            self._record.copied.add(goal_id)
            await self._all([self._sending(goal_id, SIMULATED.goal.encode(work), attack)])

    async def _clash(self, attack: Attack) -> None:
        goal = SIMULATED.goal.encode(attack.work)
        for goal_id, _ in self._others_goals(attack):
            self._record.copied.add(goal_id)
            self._record.clashes.add(goal_id)
            await self._all([self._sending(goal_id, goal, attack)])

    async def _odd_goals(self, attack: Attack) -> None:
        odd = [b"", b"\xc1", b"\x81\xa3key", encode({FORGED: 1}), encode({"key": FORGED})]
        for index in range(attack.count):
            goal_id = self._chance.randbytes(16)
            await self._all([self._sending(goal_id, odd[index % len(odd)], attack)])

    async def _follow(self, attack: Attack) -> None:
        goal_id, _ = self._others_goals(attack)[0]
        after = [None, 0, 5][attack.target % 3]
        await self._all(
            Follow(next(self._ids), SIMULATED.name, goal_id, after, own=False, credit=attack.credit)
            for _ in range(attack.count)
        )

    async def _own(self, attack: Attack) -> None:
        for goal_id, _ in self._others_goals(attack):
            message = Follow(next(self._ids), SIMULATED.name, goal_id, 0, True, attack.credit)
            await self._all([message])

    # Other requests

    async def _watch(self, attack: Attack) -> None:
        await self._all(
            WatchStatus(next(self._ids), SIMULATED.name, attack.credit or 0)
            for _ in range(attack.count)
        )

    async def _cancel_all(self, attack: Attack) -> None:
        if Permission.CANCEL in self.plan.may:
            self._record.may_cancel(None)
        await self._all(
            CancelGoals(next(self._ids), SIMULATED.name, None, None) for _ in range(attack.count)
        )

    async def _cancel_others(self, attack: Attack) -> None:
        for goal_id, _ in self._others_goals(attack):
            if Permission.CANCEL in self.plan.may:
                self._record.may_cancel(goal_id)
            await self._all([CancelGoals(next(self._ids), SIMULATED.name, goal_id, None)])

    async def _ask(self, attack: Attack) -> None:
        name = SIMULATED.name
        for _ in range(attack.count):
            await self._all(
                [
                    ListActions(next(self._ids)),
                    AskPeers(next(self._ids), name),
                    AskPlaces(next(self._ids), name, 2**31 - 1),
                    AwaitServer(next(self._ids), name),
                ]
            )

    async def _forged_texts(self, attack: Attack) -> None:
        goal_id = self._chance.randbytes(16)
        await self._all(
            [
                SendGoal(next(self._ids), FORGED, goal_id, b"\xc0", attack.credit),
                CancelGoals(next(self._ids), FORGED, goal_id, None),
                WatchStatus(next(self._ids), FORGED, 1),
                AskPeers(next(self._ids), FORGED),
                Goodbye(FORGED),
            ]
        )

    # Messages about requests

    async def _foreign_ids(self, attack: Attack) -> None:
        for _ in range(attack.count):
            number = self._chance.choice([0, 10**6, 2**63 - 1])
            await self._all([Credit(number, 2**31 - 1), Close(number), Received(number)])

    async def _close(self, attack: Attack) -> None:
        wire = await self._connected()
        kinds: list[type[Close | Received]] = self._chance.choice(
            [[Close], [Received], [Close, Received], [Received, Received]]
        )
        for number in tuple(wire.requests)[-attack.count :]:
            for kind in kinds:
                await wire.send(kind(number))

    async def _credit(self, attack: Attack) -> None:
        wire = await self._connected()
        for number in wire.requests:
            await wire.send(Credit(number, 2**31 - 1))

    async def _same_id(self, attack: Attack) -> None:
        number = next(self._ids)
        watch = WatchStatus(number, SIMULATED.name, 0)
        await self._all([watch, watch])

    # Connections

    async def _hello_again(self, _attack: Attack) -> None:
        await self._all([self._hello()])

    async def _hellos(self, attack: Attack) -> None:
        for _ in range(min(attack.count, 10)):
            wire = await self._dial()
            await wire.send(self._hello())
            if attack.pause:
                await wire.send(ListActions(next(self._ids)))
            await wire.leave(self.plan.leaves)

    async def _no_hello(self, attack: Attack) -> None:
        for _ in range(attack.count * 2):
            await self._dial(heartbeats=False)
        await anyio.sleep(attack.pause)

    async def _odd_hello(self, attack: Attack) -> None:
        hello = self._hello()
        odd = [
            Hello(VERSION + 1, 1.0),
            Hello(VERSION, 1.0, "token" * 500),
            Hello(VERSION, 1.0, hello.token, bytes(15)),
            Hello(VERSION, 1.0, hello.token, bytes(4000)),
            Hello(VERSION, 1.0, hello.token, hello.session, 1),
        ]
        for index in range(min(attack.count, len(odd))):
            wire = await self._dial()
            await wire.send(odd[(attack.target + index) % len(odd)])

    async def _large_hello(self, attack: Attack) -> None:
        for _ in range(min(attack.count, 5)):
            wire = await self._dial(heartbeats=False)
            await wire.send_bytes(header(10**5) + bytes(5_000))
        await anyio.sleep(attack.pause)

    async def _no_permission_to_speak(self, attack: Attack) -> None:
        wire = await self._dial()
        await wire.send(ListActions(next(self._ids)))

    async def _garbage(self, attack: Attack) -> None:
        wire = await self._connected()
        wire.is_cut_short = True  # its first four bytes are a length
        await wire.send_bytes(self._chance.randbytes(10 * attack.count))

    async def _wrong_message(self, attack: Attack) -> None:
        wire = await self._connected()
        wrong = [
            b"",
            b"\x90",
            b"\x91\xcc\xff",  # an unknown tag
            encode(Welcome(VERSION, 1.0)),
            encode([17, -1, "", bytes(16), b"", 0]),
            encode([18, 1, "", bytes(15), None, False, 0]),
            encode([22, 1])[:-1] + b"\x91" * 5_000,  # a request in a deep nest
        ]
        frame = wrong[attack.target % len(wrong)]
        await wire.send_bytes(header(len(frame)) + frame)

    async def _half(self, attack: Attack) -> None:
        wire = await self._connected()
        wire.is_cut_short = True
        await wire.send_bytes(header(1000 * attack.count) + bytes(10 * attack.count))
        await anyio.sleep(attack.pause)

    async def _too_large(self, _attack: Attack) -> None:
        wire = await self._connected()
        await wire.send_bytes(header(MAX_FRAME + 1) + bytes(1000))

    async def _stolen_session(self, attack: Attack) -> None:
        if not self._record.scenario.server.asks_for_tokens:
            return  # the session is then all that a client proves itself with
        wire = await self._dial()
        self._wire = wire
        await wire.send(self._hello(self._session_of(attack.target)))
        await self._own(attack)
