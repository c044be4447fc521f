"""`Sources`: the servers whose actions a page shows, and the topics beside them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Sequence

import msgspec

from fibaction.border.abc import Absence
from fibaction.words.goals import WorkerInfo


class ListedServer(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of the list of servers."""

    name: str
    """The namespace in which its actions are served; empty if they keep their names."""
    url: str
    """Its URL, without settings."""
    actions: Sequence[str] = ()
    """The names under which its actions are served."""
    away: Absence | None = None
    """The time in which it cannot be reached; None if it can be."""
    workers: Sequence[WorkerInfo] = ()
    """The workers of a fleet."""
    version: str = ""
    """Its version of fibaction; empty if it does not tell it."""


class Sources(ABC):
    """The servers whose actions are served once more at one address."""

    @abstractmethod
    async def infos(self) -> list[ListedServer]:
        """Return the servers, as they are now."""

    @abstractmethod
    def reached(self) -> dict[str, bool]:
        """Return whether each server can be reached now, as far as that is known, by its name."""

    @abstractmethod
    def topics(self) -> dict[str, str]:
        """Return the topics of the servers that are nodes of ROS, and the names of their types.

        A topic has the name of its server in front, as actions have.
        """

    @abstractmethod
    def messages(self, topic: str) -> AsyncGenerator[bytes, None]:
        """Read a topic: yield its type and the JSON Schema of its messages, then its messages, each
        of them in MessagePack. A slow reader gets the newest ones.

        Raises:
            TransportError: The topic cannot be read.
        """
