"""The settings of one fleet, for a client or a worker."""

from __future__ import annotations

import secrets
import socket
import ssl

import msgspec

from fibaction.wire.settings import ClientSettings, ServerSettings
from fibaction.wire.tls_files import TlsFiles
from fibaction.words.errors import TransportError
from fibaction.words.goal_history import GoalHistory
from fibaction_transports.nats.names import token_of

MANY = 3
"""The number of brokers from which on records are kept by several of them."""
LEASE, LEASE_OF_MANY = 5.0, 15.0
"""Seconds of a lease with one broker, and with three or more."""
LEAST_LEASE, LEAST_LEASE_OF_MANY = 2.0, 12.0
"""The shortest leases. When one of three brokers fails, all writes wait about 7 seconds."""
LONGEST_LEASE = 3600.0
LONGEST_NAME = 100
"""Characters of the names of fleets and workers, as tokens; names of streams are limited."""


class FleetSettings(msgspec.Struct, frozen=True):
    """The settings of one fleet."""

    fleet: str
    servers: tuple[str, ...] = ("127.0.0.1:4222",)
    """The brokers, each as `host:port`."""
    worker: str = ""
    """The name of this worker, or of the one to connect to; empty for a new name, or any worker."""
    lease: float = 0.0
    """Seconds after which a worker counts as lost; 0 for the default."""
    replicas: int = 0
    """Brokers that keep each record; 0 for the default."""
    history: GoalHistory | None = None
    """The bounds of the history that this worker keeps; None if it keeps none."""
    user: str = ""
    password: str = ""
    login_token: str = ""
    """The token for the brokers; clients and workers have another one for each other."""
    creds: str = ""
    """The path of a credentials file for the brokers, or of a secret key."""
    tls: TlsFiles | ssl.SSLContext | None = None
    client: ClientSettings = msgspec.field(default_factory=ClientSettings)
    server: ServerSettings = msgspec.field(default_factory=ServerSettings)

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A name is empty or too long, or a number is out of range.
        """
        for what, name in (("fleet", self.fleet), ("worker", self.worker)):
            if len(token_of(name)) > LONGEST_NAME:
                raise ValueError(
                    f"the name of the {what} is too long: it has at most {LONGEST_NAME} characters,"
                    f" and each but a letter, a digit, _ and - counts as three or more"
                )
        if not self.fleet:
            raise ValueError("the fleet has no name")
        if self.lease and not LEAST_LEASE <= self.lease <= LONGEST_LEASE:
            raise ValueError(
                f"lease is between {LEAST_LEASE:g} and {LONGEST_LEASE:g} s, not {self.lease:g}"
            )
        if self.replicas not in (0, 1, 3, 5):
            raise ValueError(f"replicas is 1, 3 or 5, not {self.replicas}")

    def __repr__(self) -> str:
        return "<FleetSettings>"  # a password has no place in a log

    @property
    def url(self) -> str:
        """The URL of the fleet, without logins and settings."""
        from urllib.parse import quote

        scheme = "nats" if self.tls is None else "nats+tls"
        return f"{scheme}://{','.join(self.servers)}/{quote(self.fleet, safe='')}"

    def of_worker(self, brokers: int) -> FleetSettings:
        """Return the settings with a name and a lease for a worker, with so many brokers.

        Raises:
            TransportError: The lease is shorter than the brokers need to replace a lost one.
        """
        many = brokers >= MANY
        least = LEAST_LEASE_OF_MANY if many else LEAST_LEASE
        lease = self.lease or (LEASE_OF_MANY if many else LEASE)
        if lease < least:
            raise TransportError(
                f"a lease of {lease:g} s is too short for {brokers} brokers, which need some"
                f" seconds to replace a lost one: give lease={least:g} or more"
            )
        return msgspec.structs.replace(self, worker=self.worker or new_name(), lease=lease)


def new_name() -> str:
    """Return a name for a worker: that of its machine, and a random part."""
    return f"{socket.gethostname()[:40]}-{secrets.token_hex(3)}"
