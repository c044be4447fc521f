"""`CalledAction`: an action as a call needs it: it encodes goals, and decodes the rest.

An `Action` does both for each of its types, so a type checker would not take one with a result of
`str` where the caller asks for any `object`, as `print(await call(...))` does.
"""

from __future__ import annotations

from typing import Protocol, TypeVar

T_co = TypeVar("T_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)
FeedbackT_co = TypeVar("FeedbackT_co", covariant=True)


class Encodes(Protocol[T_contra]):
    """A codec, as it is used for what is sent."""

    def encode(self, value: T_contra, /) -> bytes:
        """Turn a value into bytes."""
        ...


class Decodes(Protocol[T_co]):
    """A codec, as it is used for what is received."""

    def decode(self, payload: bytes, /) -> T_co:
        """Turn bytes into a value."""
        ...


class CalledAction(Protocol[T_contra, FeedbackT_co, T_co]):
    """An action, by the types of its goal, its feedback and its result."""

    @property
    def goal(self) -> Encodes[T_contra]:
        """The codec of the goal."""
        ...

    @property
    def feedback(self) -> Decodes[FeedbackT_co]:
        """The codec of the feedback."""
        ...

    @property
    def result(self) -> Decodes[T_co]:
        """The codec of the result."""
        ...
