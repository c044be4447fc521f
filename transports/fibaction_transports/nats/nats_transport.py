"""`nats://brokers/fleet` and `nats+tls://brokers/fleet`."""

from __future__ import annotations

import ssl
from collections.abc import AsyncGenerator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any, ClassVar, Unpack
from urllib.parse import SplitResult, unquote, urlsplit

from fibaction.border.abc import Connection, Endpoint
from fibaction.border.event_loop import asyncio_task
from fibaction.border.goal_store import GoalStore
from fibaction.wire.client.connection import open_connection
from fibaction.wire.settings import WireKeywords
from fibaction.wire.tls_files import TlsFiles
from fibaction.wire.transport import ConfiguredTransport
from fibaction.words.errors import TransportError
from fibaction.words.goal_history import DAY, GoalHistory
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings

if TYPE_CHECKING:
    from fibaction_transports.nats.worker.worker import Worker

PORT = 4222
"""The default port of a broker."""
SERVERS = (f"127.0.0.1:{PORT}",)
"""The default brokers: one on this machine."""
LIKE = "nats://host:4222/fleet, with settings after ? such as worker="


class NatsTransport(ConfiguredTransport):
    """A fleet of workers, who find each other and their clients by brokers of NATS.

    As a server it is one worker of the fleet.
    """

    own_settings = ("tls",)
    own_url_settings: ClassVar = {
        "worker": str,
        "lease": float,
        "replicas": int,
        "history_days": float,
        "history_goals": int,
        "creds": str,
    }
    tls_schemes = ("nats+tls",)

    def __init__(
        self,
        servers: str | Sequence[str] = SERVERS,
        fleet: str = "fibaction",
        *,
        worker: str = "",
        lease: float | None = None,
        replicas: int | None = None,
        history_days: float | None = None,
        history_goals: int | None = None,
        user: str = "",
        password: str = "",
        login_token: str = "",
        creds: str | None = None,
        tls: TlsFiles | ssl.SSLContext | None = None,
        **settings: Unpack[WireKeywords],
    ) -> None:
        """Take the brokers and the fleet, and the settings of each transport over the wire.

        A URL has `worker`, `lease`, `replicas`, `history_days`, `history_goals`, `creds` and the
        text, number and boolean settings after its `?`, and the login for the brokers before an
        `@`. With `nats+tls://` it has the paths `ca`, `cert` and `key` as well.

        Args:
            servers: The brokers, each as `host` or `host:port`; one that answers is enough.
            fleet: The name of the fleet; several fleets may share brokers.
            worker: The name of this worker, or the one worker to connect to.
            lease: Seconds after which a worker that is silent counts as lost; None for 15 with
                three brokers, and 5 with one.
            replicas: The number of brokers that keep each record; None for three if there are
                three, and one otherwise.
            history_days: Days after its end for which the fleet keeps a goal in its history;
                `math.inf` without this bound, None for 30.
            history_goals: The number of goals in the history, of all actions together; None for
                10,000. Without both, this worker keeps no history.
            user: The user for the brokers.
            password: The password of the user.
            login_token: The token for the brokers; the setting `token` is for the workers.
            creds: The path of a credentials file for the brokers, or of a secret key (nkey seed).
            tls: The files to make TLS to the brokers from, or a context.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A name or a number is out of range, a broker is not `host:port`, `orphans`
                is another word, or a token is not valid text.
        """
        super().__init__(**settings)
        names = servers.split(",") if isinstance(servers, str) else servers
        self.settings = FleetSettings(
            fleet,
            tuple(map(_server, names)),
            worker=worker,
            lease=0.0 if lease is None else lease,
            replicas=0 if replicas is None else replicas,
            history=_history(history_days, history_goals),
            user=user,
            password=password,
            login_token=login_token,
            creds=creds or "",
            tls=tls,
            client=self.client_settings,
            server=self.server_settings,
        )
        self._names = FleetNames(fleet)
        self._worker: Worker | None = None

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the brokers, the login and the fleet in a URL."""
        login, _, servers = parts.netloc.rpartition("@")
        fleet = parts.path[1:]
        if not fleet or "/" in fleet:
            which = "has more than a fleet behind the brokers" if fleet else "does not name a fleet"
            raise ValueError(f"it {which}: a URL is like {LIKE}")
        address: dict[str, Any] = {"fleet": unquote(fleet)}
        if servers:
            address["servers"] = servers
        user, is_user, password = login.partition(":")
        if is_user:
            address.update(user=unquote(user), password=unquote(password))
        elif login:
            address["login_token"] = unquote(login)
        return address

    @property
    def url(self) -> str:
        """The address as a URL, without logins and settings."""
        return self.settings.url

    @asynccontextmanager
    async def goal_store(self) -> AsyncGenerator[GoalStore | None, None]:
        """See `Transport.goal_store`."""
        async with self._open_worker() as worker:
            yield worker.store

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        """See `Transport.serve`."""
        served = {endpoint.info.name for endpoint in endpoints}
        if len(served) < len(endpoints):
            raise TransportError("two of the endpoints serve actions of the same name")
        async with AsyncExitStack() as stack:
            worker = self._worker
            if worker is None:
                worker = await stack.enter_async_context(self._open_worker())
            await stack.enter_async_context(worker.serve(endpoints))
            yield self.url

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`."""
        self._check_loop()
        from fibaction_transports.nats.broker.nats_broker import open_broker

        async with open_broker(self.settings) as broker:
            if self.settings.worker:
                from fibaction_transports.nats.lines import ClientLines

                max_frame = self.client_settings.max_frame
                lines = ClientLines(broker, self._names, max_frame=max_frame)
                await lines.open()
                async with open_connection(
                    lambda: lines.dial(self.settings.worker), self.url, self.client_settings
                ) as connection:
                    yield connection
            else:
                from fibaction_transports.nats.client.connection import open_fleet

                async with open_fleet(broker, self._names, self.settings) as fleet:
                    yield fleet

    @asynccontextmanager
    async def _open_worker(self) -> AsyncGenerator[Worker, None]:
        """Join the fleet for as long as the block lasts."""
        self._check_loop()
        if self._worker is not None:
            raise TransportError(
                f"{self.url}: this transport is a worker already; make another one for another"
                f" worker"
            )
        from fibaction_transports.nats.broker.nats_broker import open_broker
        from fibaction_transports.nats.worker.worker import open_worker

        async with open_broker(self.settings) as broker:
            settings = self.settings.of_worker(broker.brokers)
            await broker.create_streams(self._names, replicas=settings.replicas)
            async with open_worker(broker, self._names, settings) as worker:
                self._worker = worker
                try:
                    yield worker
                finally:
                    self._worker = None

    def _check_loop(self) -> None:
        if asyncio_task() is None:
            raise TransportError(
                f"{self.url} needs asyncio: run this program on asyncio, as with asyncio.run() or"
                f" anyio.run()"
            )


def _history(days: float | None, goals: int | None) -> GoalHistory | None:
    """Return the bounds of a history; None if there is none.

    Raises:
        ValueError: One of them is out of range.
    """
    if days is None and goals is None:
        return None
    if days is not None and not days > 0:
        raise ValueError(f"history_days is more than 0, not {days:g}")
    if goals is not None and goals < 1:
        raise ValueError(f"history_goals is 1 or more, not {goals}")
    history = GoalHistory()
    return GoalHistory(
        seconds=history.seconds if days is None else days * DAY,
        goals=history.goals if goals is None else goals,
    )


def _server(text: str) -> str:
    """Return a broker as `host:port`.

    Raises:
        ValueError: It is not one; the text says how.
    """
    try:
        parts = urlsplit(f"//{text}")
        port = PORT if parts.port is None else parts.port
    except ValueError as exc:
        raise ValueError(f"invalid broker {text!r}: {exc}") from exc
    host = parts.hostname or ""
    if not host or parts.netloc != text or "@" in text or not host.isprintable() or " " in host:
        raise ValueError(f"invalid broker {text!r}: a URL is like {LIKE}")
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
