"""Budgets: how much a peer can make this participant send.

UDP does not show that a datagram comes from the address that it says, and RTPS has no handshake.
So, as QUIC does, a participant is sent at most three times the bytes that came in its name, until
a datagram for this very participant has come from where it says it is: whoever sends that has
received something, because identifiers of participants are random.

Later, lost samples are repeated for it as far as its budget goes. It grows with what is written
for it, since a repair is needed for something that was lost, and slowly with the time.
"""

from __future__ import annotations

from fibaction_transports.rtps.limits import MIB

UNPROVEN_FACTOR = 3
"""Bytes that are sent to a participant for each byte that came in its name."""
REPAIR_FACTOR = 2
"""Bytes that are repeated for each byte that is written."""
REPAIRS_AT_ONCE = 4 * MIB
"""Bytes that are repeated for a participant for which nothing is written, at once."""
REPAIRS_PER_SECOND = MIB
MOST_REPAIRS = 64 * MIB
"""The largest budget."""


class PeerBudget:
    """The bytes that may be sent to one other participant."""

    def __init__(self, now: float) -> None:
        self._sendable = 0
        self._repairs = float(REPAIRS_AT_ONCE)
        self._at = now
        self.is_proven = False
        """True if it has shown that it receives what it is sent."""

    def earn(self, size: int) -> None:
        """Note that so many bytes came in its name."""
        self._sendable += UNPROVEN_FACTOR * size

    def may_send(self, size: int) -> bool:
        """Return whether it may be sent so many bytes, and count them."""
        if self.is_proven:
            return True
        if size > self._sendable:
            return False
        self._sendable -= size
        return True

    def write(self, size: int) -> None:
        """Note that so many bytes are written for it."""
        self._repairs = min(self._repairs + REPAIR_FACTOR * size, MOST_REPAIRS)

    def may_repair(self, size: int, now: float) -> bool:
        """Return whether so many bytes may be repeated now, and count them.

        One sample of any size may be repeated if anything is left.
        """
        if self._repairs < REPAIRS_AT_ONCE:
            earned = max(0.0, now - self._at) * REPAIRS_PER_SECOND
            self._repairs = min(self._repairs + earned, REPAIRS_AT_ONCE)
        self._at = now
        if self._repairs <= 0:
            return False
        self._repairs -= size
        return True


class HostRates:
    """The number of new participants of each host that are taken: many at once, then some for each
    second.
    """

    def __init__(self, at_once: int, per_second: float, hosts: int) -> None:
        self._at_once = at_once
        self._per_second = per_second
        self._most_hosts = hosts
        self._hosts: dict[str, tuple[float, float]] = {}

    def take(self, host: str, now: float) -> bool:
        """Take a new participant of a host; return False if there were too many."""
        left = self._left(host, now)
        if left < 1 or (host not in self._hosts and not self._has_room(now)):
            return False
        self._hosts[host] = left - 1, now
        return True

    def _left(self, host: str, now: float) -> float:
        left, at = self._hosts.get(host, (self._at_once, now))
        return min(left + (now - at) * self._per_second, self._at_once)

    def _has_room(self, now: float) -> bool:
        """Return whether another host can be noted; forget those that may begin again in full."""
        if len(self._hosts) >= self._most_hosts:
            for host in [each for each in self._hosts if self._left(each, now) >= self._at_once]:
                del self._hosts[host]
        return len(self._hosts) < self._most_hosts
