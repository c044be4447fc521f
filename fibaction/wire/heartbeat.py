"""The rule when a peer counts as dead.

Each side tells the other how often it will send something, at least: its heartbeat. Where there is
nothing else to say it sends a `Ping`. A peer is dead after `MISSED` of its heartbeats without a
byte from it, or after as many of the own heartbeats without progress of what is being written.

Sans-I/O, and without a clock: `Link` counts steps of half a heartbeat, so that nothing has to be
noted for each message, and a peer is not blamed for the time in which this process did not run.
"""

from __future__ import annotations

import math

from fibaction.words.errors import ConnectionLost

MISSED = 4
"""A peer is considered dead after this many missed heartbeats. Late or lost ones are tolerated."""

FIRST_STEP = 0.5
"""The longest step before the sides know each other's heartbeats, in seconds."""


class Heartbeat:
    """The heartbeats of both sides of one connection, and the time since each was seen."""

    def __init__(self, peer: str, interval: float) -> None:
        self.interval = interval
        """Seconds between the heartbeats of this side."""
        self.peer_interval = interval
        """Seconds between the heartbeats of the peer; its first message tells them."""
        self.is_agreed = False
        """True if the peer has told its heartbeat, in its first message."""
        self._peer = peer
        self._silent = self._stuck = self._unsaid = 0.0

    def agree(self, peer_interval: float, longest: float = math.inf) -> None:
        """Note the heartbeat of the peer, and the longest one that it accepts of this side."""
        self.peer_interval = peer_interval
        self.interval = min(self.interval, longest)
        self.is_agreed = True

    @property
    def step(self) -> float:
        """Seconds between two calls of `tick`."""
        step = min(self.interval, self.peer_interval) / 2
        # The first message of the peer may ask for shorter ones, and no step is cut short.
        return step if self.is_agreed else min(step, FIRST_STEP)

    def tick(self, step: float, *, has_heard: bool, has_said: bool, is_stuck: bool) -> bool:
        """Count a step of so many seconds; return whether a heartbeat is to be sent now.

        The arguments say what has happened in the step: whether anything has arrived, whether
        anything was written, and whether a write is under way that has made no progress.

        Raises:
            ConnectionLost: The peer is dead.
        """
        self._silent = 0.0 if has_heard else self._silent + step
        if self._silent > MISSED * self.peer_interval:
            raise ConnectionLost(f"{self._peer} has been silent for {self._silent:.1f} s")
        self._stuck = self._stuck + step if is_stuck else 0.0
        if self._stuck > MISSED * self.interval:
            raise ConnectionLost(f"{self._peer} has read nothing for {self._stuck:.1f} s")
        self._unsaid = 0.0 if has_said else self._unsaid + step
        if self._unsaid < self.interval / 2:
            return False
        self._unsaid = 0.0
        return True
