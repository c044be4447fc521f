"""Attacks on nodes over Zenoh: many messages, requests, answers and tokens of any bytes.

Whatever is wrong is dropped and counted, the log has some lines in all, and an honest pair beside
the attack goes on.
"""

from __future__ import annotations

import random
import uuid
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import contextmanager
from itertools import count

import anyio
import pytest
import zenoh
from anyio import to_thread
from hypothesis import given
from hypothesis import strategies as st

from fibaction import (
    GoalHandle,
)
from fibaction_transports.ros2.on_zenoh.config import Configuration
from fibaction_transports.ros2.on_zenoh.graph import ZenohGraph
from fibaction_transports.ros2.on_zenoh.keys import (
    KINDS,
    Entity,
    NodeTokens,
    attachment,
    read_attachment,
    read_token,
)
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.fibonacci import Feedback, Goal, Result
from tests.support.ros_ends import both_ends

PATIENCE = 60.0
MANY = 1_000
MOST_LINES = 60
"""Lines of the log for an attack of thousands."""
_words = st.text(st.sampled_from("/%:,@*1aNSP_é"), max_size=20)
_tokens = st.one_of(
    st.text(max_size=200),
    st.builds(
        "@ros2_lv/{}/{}/0/{}/{}/%/%/{}/{}/{}/{}/{}".format,
        st.sampled_from(["0", "9" * 9, "x", ""]),
        _words,
        _words,
        st.sampled_from([*KINDS, "NN", "XX"]),
        _words,
        _words,
        _words,
        _words,
        st.text(st.sampled_from(":,0123456789x"), max_size=40),
    ),
)


@given(st.lists(_tokens, max_size=20))
def test_any_tokens_are_entities_or_ignored_and_leave_nothing(tokens: list[str]) -> None:
    graph = ZenohGraph()
    for token in tokens:
        graph.add(token)
        entity = read_token(token)
        if entity is not None:
            assert len(entity.gid) == 16
            assert len(entity.wire_gid) == 16
    for topic, _ in graph.topics():
        assert graph.publishers(topic) or graph.subscriptions(topic)
    assert len(graph.nodes()) <= len(tokens)
    assert graph.served_actions() is not None
    for token in tokens:
        graph.remove(token)
    assert (graph.discovery().known >= 0, graph.nodes(), graph.topics()) == (True, set(), [])


@given(st.binary(max_size=60))
def test_any_bytes_are_an_attachment_of_ros_or_none(data: bytes) -> None:
    read = read_attachment(data)
    assert read is None or (len(data), len(read.gid)) == (33, 16)


class Attacker:
    """Another session, at the ends of an action."""

    def __init__(self, opened: zenoh.Session, ends: list[Entity], seed: int) -> None:
        self.session = opened
        self.keys = {
            one.topic.rpartition("/")[2]: one.key for one in ends if "_action" in one.topic
        }
        self._random = random.Random(seed)

    def content(self) -> bytes:
        head = self._random.choice([b"", b"\0\1\0\0", b"\0\0\0\0", b"\xff\xff"])
        return head + self._random.randbytes(self._random.choice([0, 1, 15, 16, 33, 400]))

    def words(self) -> bytes | None:
        number = self._random.choice([0, 1, -(2**63), 2**63 - 1])
        kinds = [None, b"", self.content(), attachment(number, self._random.randbytes(16))]
        return self._random.choice(kinds)

    def publish(self) -> None:
        for part in ("feedback", "status"):
            for _ in range(MANY):
                self.session.put(self.keys[part], self.content(), attachment=self.words())
            self.session.put(self.keys[part], bytes(8_000_000), attachment=self.words())

    def ask(self) -> None:
        nothing: zenoh.handlers.Callback[zenoh.Reply]
        nothing = zenoh.handlers.Callback(lambda reply: None, indirect=False)
        for part in ("send_goal", "cancel_goal", "get_result"):
            for _ in range(MANY):
                payload = self.content()
                if part == "cancel_goal":
                    payload = payload[:20]  # any goal before a time may be canceled by anyone
                self.session.get(self.keys[part], nothing, payload=payload, attachment=self.words())
            self.session.get(self.keys[part], nothing)

    def announce(self) -> None:
        made = NodeTokens(0, "5", count(), "/", "attacker")
        liveliness = self.session.liveliness()
        declared = [liveliness.declare_token(f"{made.node()}{'x' * 2_000}")]
        for number in range(MANY):
            name = f"{made.node()}/%n{number}/a/b/{self._random.randrange(10**9)}"
            declared.append(liveliness.declare_token(name.replace("/NN/", "/MP/")))
        for one in declared:
            one.undeclare()


ATTACKS: dict[str, Callable[[Attacker], None]] = {
    "messages": Attacker.publish,
    "requests": Attacker.ask,
    "tokens": Attacker.announce,
}


@contextmanager
def attacker(router: int, action: str, seed: int = 7) -> Iterator[Attacker]:
    """Open a session that knows the ends of an action by their tokens."""
    where = Configuration(mode="client", locators=[f"tcp/127.0.0.1:{router}"], environ={})
    with zenoh.open(where.made()) as opened:
        tokens = [str(one.ok.key_expr) for one in opened.liveliness().get("@ros2_lv/**") if one.ok]
        read = [one for one in map(read_token, tokens) if one is not None]
        yield Attacker(opened, [one for one in read if one.topic.startswith(f"{action}/")], seed)


def attack(name: str, router: int, action: str) -> None:
    with attacker(router, action) as found:
        ATTACKS[name](found)


@pytest.mark.anyio
@pytest.mark.parametrize("name", ATTACKS)
async def test_an_attack_leaves_an_honest_pair_alone_and_the_log_short(
    name: str, router: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "fibaction.ros2")
    space = f"/t{uuid.uuid4().hex}"

    async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        for number in range(40):
            yield Feedback([number])
            await anyio.sleep(0.01)
        yield Result([40])

    async with both_ends(f"zenoh://?namespace={space}", execute, patience=PATIENCE) as client:
        await client.wait_for_server()
        async with client.send_goal(Goal(1)) as goal:
            await to_thread.run_sync(attack, name, router, f"{space}/fibonacci")
            heard = [one.partial_sequence async for one in goal.feedback]
            assert await goal.result() == Result([40])
        assert heard == [[number] for number in range(40)]
        assert await client.call(Goal(1)) == Result([40])
    lines = [one for one in caplog.records if one.name == "fibaction.ros2"]
    assert len(lines) < MOST_LINES, caplog.text
