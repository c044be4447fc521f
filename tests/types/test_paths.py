"""`pathlib.Path` in the types of an action."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec
import pytest

from fibaction import Action, ProtocolError
from fibaction.types.action import Codec

PATH = {"type": "string", "format": "path"}


class Copy(msgspec.Struct):
    source: Path
    targets: list[PurePosixPath] = []
    log: Path | None = None
    into: Path = msgspec.field(default_factory=lambda: Path("/tmp"))


class Noted(msgspec.Struct):
    source: Path
    note: object


@dataclass
class Move:
    source: Path
    into: Path = field(default_factory=lambda: Path("/tmp"))


VALUES: list[Any] = [
    Path("a/b.txt"),
    [Path("a"), Path("/b")],
    {"a": Path("c")},
    Copy(Path("a"), [PurePosixPath("b")], Path("log")),
    Noted(Path("a"), 3),
    Move(Path("ä")),
]


@pytest.mark.parametrize("value", VALUES, ids=[str(type(value).__name__) for value in VALUES])
def test_a_path_arrives_as_a_path(value: Any) -> None:
    kinds: dict[Any, Any] = {list: list[Path], dict: dict[str, Path]}
    kind = kinds.get(type(value), type(value))
    codec: Codec[Any] = Codec(Path if isinstance(value, Path) else kind)
    assert codec.decode(codec.encode(value)) == value
    assert codec.accepts(value)


def test_a_path_is_text_on_the_wire_and_in_the_schema() -> None:
    codec: Codec[Any] = Codec(Copy)
    assert msgspec.msgpack.decode(codec.encode(Copy(Path("a"))))["source"] == "a"
    properties = codec.schema()["$defs"]["Copy"]["properties"]
    assert properties["source"] == PATH
    assert properties["into"] == {**PATH, "default": "/tmp"}
    assert Codec(Path).schema() == PATH


def test_what_is_not_a_path_is_told_with_its_place() -> None:
    with pytest.raises(ProtocolError, match=r"Expected `str`, got `int` - at `\$\.source`"):
        Codec(Copy).decode(msgspec.msgpack.encode({"source": 3}))


def test_a_default_that_no_schema_could_have_is_told_with_what_to_write() -> None:
    class Wrong(msgspec.Struct):
        source: Path = Path("a")

    with pytest.raises(TypeError, match=r"the default of 'source' is a path: write `field\(def"):
        Action("copy", goal=Wrong, feedback=int, result=int)


def test_another_object_is_not_sent() -> None:
    with pytest.raises(TypeError, match="Encoding objects of type object is unsupported"):
        Codec(Noted).encode(Noted(Path("a"), object()))
    assert Codec(Noted).schema() == {}  # which allows anything, as without a path
