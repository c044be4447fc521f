"""A process with readers and writers of texts, of Cyclone DDS."""

from __future__ import annotations

from typing import Any

from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader

from tests.transports.cyclone.idl import Text
from tests.transports.cyclone.node import Node, Until, qos, readers_of, writers_of


class Topics:
    """Readers and writers by names that the tests give them; all methods are commands."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._heard: dict[str, list[str]] = {}
        self._readers: dict[str, DataReader[Any]] = {}
        self._writers: dict[str, DataWriter[Any]] = {}

    async def read(self, topic: str, name: str = "", **settings: Any) -> None:
        """Make a reader."""
        heard = self._heard[name] = []

        def take(sample: Any) -> None:
            heard.append(sample.data)

        self._readers[name] = self._node.read(topic, Text, take, qos(**settings))

    async def write(self, topic: str, name: str = "", **settings: Any) -> None:
        """Make a writer."""
        self._writers[name] = self._node.write(topic, Text, qos(**settings))

    async def send(self, texts: list[tuple[str, int]], name: str = "") -> None:
        """Write samples: each a text so many times."""
        for text, times in texts:
            self._writers[name].write(Text(text * times))

    async def heard(self, count: int, name: str = "") -> list[list[Any]]:
        """Return of so many texts their first character, length and number of different ones."""
        texts = self._heard[name]
        await Until(lambda: len(texts) >= count)
        return [[text[:1], len(text), len(set(text))] for text in texts]

    async def matches(self, name: str = "") -> int:
        """Return the number of writers that a reader has, or of readers that a writer has."""
        if name in self._readers:
            return writers_of(self._readers[name])
        return readers_of(self._writers[name])


def main() -> None:
    """Run the process."""
    node = Node()
    node.run(Topics(node))


if __name__ == "__main__":
    main()
