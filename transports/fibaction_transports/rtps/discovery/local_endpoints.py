"""The endpoints of this participant: those of discovery, and those of the user's topics."""

from __future__ import annotations

from collections.abc import Sequence

from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.endpoints.writer_proxy import WriterProxy
from fibaction_transports.rtps.messages.ids import BUILTIN, UNKNOWN_ENTITY, Guid, is_builtin

_BUILTIN_READERS = {0xC2: b"\xc7", 0xC3: b"\xc4"}
"""The kinds of the readers of discovery, by those of its writers: with a key, and without one."""


class LocalEndpoints:
    """The endpoints of a participant, by their entities."""

    def __init__(self) -> None:
        self.writers: dict[bytes, DataWriter] = {}
        self.readers: dict[bytes, DataReader] = {}

    def user_writers(self) -> list[DataWriter]:
        """Return the writers of the user's topics."""
        return [found for entity, found in self.writers.items() if not is_builtin(entity)]

    def user_readers(self) -> list[DataReader]:
        """Return the readers of the user's topics."""
        return [found for entity, found in self.readers.items() if not is_builtin(entity)]

    def matched(self, entity: bytes, writer: Guid) -> Sequence[WriterProxy]:
        """Return what takes something of a writer, at the matched readers that it is for."""
        if entity == UNKNOWN_ENTITY:
            if writer[-1] & BUILTIN != BUILTIN:
                readers = self.readers.values()
                return [each.proxies[writer] for each in readers if writer in each.proxies]
            entity = writer.entity[:3] + _BUILTIN_READERS.get(writer[-1], b"\xc7")
        reader = self.readers.get(entity)
        if reader is None or writer not in reader.proxies:
            return ()
        return (reader.proxies[writer],)

    def close(self) -> None:
        """Let every endpoint forget what it is matched with."""
        for writer in self.writers.values():
            writer.close()
        for reader in self.readers.values():
            reader.close()
