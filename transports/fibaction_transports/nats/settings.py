"""The settings of one fleet, for a client or a worker."""

from __future__ import annotations

import secrets
import socket
from ssl import SSLContext
from typing import ClassVar

import msgspec

from fibaction.wire.settings import WireSettings
from fibaction.wire.transport import TlsFiles
from fibaction.words.errors import TransportError
from fibaction.words.goal_query import DAY, GoalHistory
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


class NatsSettings(WireSettings, frozen=True, kw_only=True):
    """The settings of a `NatsTransport`."""

    only_in_code: ClassVar[tuple[str, ...]] = ("user", "password", "login_token")
    only_for_servers: ClassVar[tuple[str, ...]] = (
        *WireSettings.only_for_servers,
        "replicas",
        "history_days",
        "history_goals",
    )

    worker: str = ""
    """The name of this worker, or the one worker to connect to; empty for a name that is made of
    the host's, or for all workers."""
    lease: float = 0.0
    """Seconds after which a worker that is silent counts as lost; 0 is 5, and 15 with three brokers
    or more."""
    replicas: int = 0
    """The number of brokers that keep each record, when the first worker makes the streams; 0 is 1,
    and 3 with three brokers or more."""
    history_days: float | None = None
    """Days after its end for which the fleet keeps a goal in its history; `math.inf` without this
    bound, None for 30."""
    history_goals: int | None = None
    """The number of goals in the history, of all actions together; None for 10,000. Without both, a
    worker keeps no history."""
    user: str = ""
    """The user for the brokers; in a URL before the `@`, as the next two."""
    password: str = ""
    """The password of the user."""
    login_token: str = ""
    """The token for the brokers; the setting `token` is for the workers."""
    creds: str = ""
    """The path of a credentials file for the brokers, or of a file with a secret key (nkey
    seed)."""
    tls: TlsFiles | SSLContext | None = None
    """The files to make TLS to the brokers from, or a context; in a URL the paths `ca`, `cert` and
    `key`."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range.
        """
        super().__post_init__()
        if self.history_days is not None and not self.history_days > 0:
            raise ValueError(f"history_days must be more than 0, not {self.history_days:g}")
        if self.history_goals is not None and self.history_goals < 1:
            raise ValueError(f"history_goals must be 1 or more, not {self.history_goals}")
        if self.lease and not LEAST_LEASE <= self.lease <= LONGEST_LEASE:
            raise ValueError(
                f"lease must be between {LEAST_LEASE:g} and {LONGEST_LEASE:g} s, not {self.lease:g}"
            )
        if self.replicas not in (0, 1, 3, 5):
            raise ValueError(f"replicas must be 1, 3 or 5, not {self.replicas}")

    @property
    def history(self) -> GoalHistory | None:
        """The bounds of the history that this worker keeps; None if it keeps none."""
        days, goals = self.history_days, self.history_goals
        if days is None and goals is None:
            return None
        history = GoalHistory()
        return GoalHistory(
            seconds=history.seconds if days is None else days * DAY,
            goals=history.goals if goals is None else goals,
        )


class FleetSettings(NatsSettings, frozen=True):
    """The settings of one fleet, with its address."""

    fleet: str
    servers: tuple[str, ...] = ("127.0.0.1:4222",)
    """The brokers, each as `host:port`."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A name is empty or too long, or a number is out of range.
        """
        super().__post_init__()
        for what, name in (("fleet", self.fleet), ("worker", self.worker)):
            if len(token_of(name)) > LONGEST_NAME:
                raise ValueError(
                    f"the name of the {what} is too long: it has at most {LONGEST_NAME} characters,"
                    f" and each but a letter, a digit, _ and - counts as three or more"
                )
        if not self.fleet:
            raise ValueError("the fleet has no name")

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
