"""`nats://brokers/fleet` and `nats+tls://brokers/fleet`."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any, ClassVar, Unpack
from urllib.parse import SplitResult, unquote, urlsplit

from fibaction.border.abc import Connection, Endpoint
from fibaction.border.event_loop import asyncio_task
from fibaction.border.goal_store import GoalStore
from fibaction.border.settings import TransportSettings
from fibaction.border.urls import check_settings
from fibaction.wire.client.connection import open_connection
from fibaction.wire.transport import ConfiguredTransport
from fibaction.words.errors import TransportError
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings, NatsSettings

if TYPE_CHECKING:
    from fibaction_transports.keywords import NatsKeywords
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

    settings_type: ClassVar[type[TransportSettings]] = NatsSettings
    tls_schemes = ("nats+tls",)

    def __init__(
        self,
        servers: str | Sequence[str] = SERVERS,
        fleet: str = "fibaction",
        **settings: Unpack[NatsKeywords],
    ) -> None:
        """Take the brokers, the fleet and settings.

        Args:
            servers: The brokers, each as `host` or `host:port`; one that answers is enough.
            fleet: The name of the fleet; several fleets may share brokers.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A name or a number is out of range, a broker is not `host:port`, `orphans`
                is another word, or a token is not valid text.
        """
        check_settings(type(self).__name__, settings, NatsSettings.__struct_fields__)
        names = servers.split(",") if isinstance(servers, str) else servers
        self.settings = FleetSettings(fleet, tuple(map(_server, names)), **settings)
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

                max_frame = self.settings.max_frame
                lines = ClientLines(broker, self._names, max_frame=max_frame)
                await lines.open()
                async with open_connection(
                    lambda: lines.dial(self.settings.worker), self.url, self.settings
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
            async with open_worker(
                broker, self._names, settings, lambda: open_broker(settings)
            ) as worker:
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
