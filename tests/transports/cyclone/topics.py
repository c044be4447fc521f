"""A process with readers and writers of texts, of Cyclone DDS."""

from __future__ import annotations

from typing import Any

from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader

from tests.transports.cyclone.idl import Text
from tests.transports.cyclone.node import Node, answer, qos


class Topics:
    """Readers and writers by names that the tests give them."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._heard: dict[str, list[str]] = {}
        self._readers: dict[str, DataReader[Any]] = {}
        self._writers: dict[str, DataWriter[Any]] = {}
        self._expected: tuple[str, int] | None = None

    def obey(self, do: str, **arguments: Any) -> None:
        getattr(self, do)(**arguments)

    def read(self, topic: str, name: str = "", **settings: Any) -> None:
        """Make a reader."""
        heard = self._heard[name] = []

        def take(sample: Any) -> None:
            heard.append(sample.data)
            self._tell()

        self._readers[name] = self._node.read(topic, Text, take, qos(**settings))
        answer(None)

    def write(self, topic: str, name: str = "", **settings: Any) -> None:
        """Make a writer."""
        self._writers[name] = self._node.write(topic, Text, qos(**settings))
        answer(None)

    def send(self, texts: list[tuple[str, int]], name: str = "") -> None:
        """Write samples: each a text so many times."""
        for text, times in texts:
            self._writers[name].write(Text(text * times))
        answer(None)

    def heard(self, count: int, name: str = "") -> None:
        """Answer with the texts, when there are so many: the first characters and the length."""
        self._expected = name, count
        self._tell()

    def matches(self, name: str = "") -> None:
        """Answer with the number of writers that a reader has, or of readers that a writer has."""
        if name in self._readers:
            answer(len(self._readers[name].get_matched_publications()))
        else:
            answer(len(self._writers[name].get_matched_subscriptions()))

    def _tell(self) -> None:
        if self._expected is None:
            return
        name, count = self._expected
        if len(self._heard[name]) >= count:
            self._expected = None
            answer([[text[:1], len(text), len(set(text))] for text in self._heard[name]])


def main() -> None:
    """Run the process."""
    node = Node()
    node.run(Topics(node).obey)


if __name__ == "__main__":
    main()
