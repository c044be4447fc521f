"""Random types of goals: primitives with and without limits, lists, maps, unions and structs."""

from __future__ import annotations

import random
from itertools import count
from typing import Annotated, Any, Literal

import msgspec

_NUMBERS = count()


def random_type(chance: random.Random, depth: int) -> Any:
    """Return a random type: a primitive, with or without limits, or made of other types."""
    simple: list[Any] = [
        int,
        str,
        bool,
        bytes,
        None,
        Literal["a", 3],
        Annotated[int, msgspec.Meta(gt=0)],
        Annotated[int, msgspec.Meta(lt=0)],
        Annotated[float, msgspec.Meta(gt=0, le=1)],
        Annotated[float, msgspec.Meta(ge=2.5)],
        Annotated[str, msgspec.Meta(min_length=3)],
        Annotated[bytes, msgspec.Meta(min_length=3)],
    ]
    if depth == 0 or chance.random() < 0.3:
        return chance.choice(simple)
    inner = random_type(chance, depth - 1)
    lists: Any = list  # type checkers reject types that are known at run time only
    maps: Any = dict
    tuples: Any = tuple
    sized: Any = Annotated[lists[inner], msgspec.Meta(min_length=2, max_length=3)]
    made: list[Any] = [lists[inner], maps[str, inner], tuples[inner, int], sized]
    if inner is not None:
        made.append(inner | None)
    made.append(random_struct(chance, depth - 1))
    tagged = [random_struct(chance, depth - 1, tag=name) for name in ("left", "right")]
    made.append(tagged[0] | tagged[1])
    return chance.choice(made)


def random_struct(chance: random.Random, depth: int, tag: str | None = None) -> Any:
    """Return a random struct."""
    fields: list[Any] = []
    for number in range(chance.randint(0, 4)):
        kind = random_type(chance, depth)
        with_default: list[Any] = [(), (msgspec.field(default_factory=lambda: [1]),)]
        kind, default = chance.choice([(kind, ()), (kind, ()), (list[int], with_default[1])])
        fields.append((f"field{number}", kind, *default))
    return msgspec.defstruct(f"Random{next(_NUMBERS)}", fields, kw_only=True, tag=tag)
