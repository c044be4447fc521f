"""The time that large goals take: `python -m tests.tools.large_goals`.

It prints the milliseconds of the processor that a goal of 1 MiB takes, at best and at worst of
several: to be decoded, which is done in one piece, by its type; and to be checked as JSON, which is
done beside the event loop, for each of the documents that cost the most.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from time import process_time
from typing import Any

import msgspec

from fibaction import Action
from fibaction.schema.payload import JsonCodec
from fibaction.types.action import collector_paused
from tests.hostile.documents import ANYTHING, DOCUMENTS, NUMBERS, TREE, Tree

MIB = 2**20
REPEATS = 5
PAYLOADS: dict[str, tuple[Any, Any]] = {
    "text or bytes": (bytes, bytes(MIB)),
    "a list of numbers": (list[float], [1.5] * (MIB // 9)),
    "a list of small whole numbers": (list[int], [1] * MIB),
    "a list of empty lists": (list[list[int]], [[]] * MIB),
    "a list of objects": (list[Tree], [{}] * MIB),
}
"""The type and the value of goals whose payload has about 1 MiB."""


def times(work: Callable[[], object]) -> str:
    """Return the shortest and the longest time of a piece of work, in milliseconds."""
    found: list[float] = []
    for _ in range(REPEATS):
        begun = process_time()
        work()
        found.append((process_time() - begun) * 1000)
    return f"{min(found):7.0f} {max(found):7.0f}"


def check(codec: JsonCodec, text: str) -> None:
    """Read and check a document as a door does in its thread."""
    with collector_paused(), suppress(ValueError):  # some are wrong
        codec.encode(msgspec.json.decode(text), is_json=True)


def main() -> None:
    """Print the times of all."""
    print(f"{'':32} {'best':>7} {'worst':>7}")
    for name, (kind, value) in PAYLOADS.items():
        codec = Action("a", goal=kind, feedback=str, result=int).goal
        payload = msgspec.msgpack.encode(value)
        print(f"decode {name:25} {times(partial(codec.decode, payload))}")
    for name, document in DOCUMENTS.items():
        action = next(one for one in (TREE, NUMBERS, ANYTHING) if one.name == document.action)
        codec_of_json, text = JsonCodec(action.info.goal), document.text(MIB)
        print(f"check {name:26} {times(partial(check, codec_of_json, text))}")


if __name__ == "__main__":
    main()
