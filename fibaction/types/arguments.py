"""Goals that are given as arguments: what type checkers know of a call.

An action that is made of a function is called with the function's arguments, and any other action
with its goal. Beside either stand the options of the call, and at run time these are told apart by
their names: see `fibaction.client.options`.
"""

from __future__ import annotations

from typing import Generic, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
T_co = TypeVar("T_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)
FeedbackT_co = TypeVar("FeedbackT_co", covariant=True)
ResultT_co = TypeVar("ResultT_co", covariant=True)


class Arguments(Generic[P]):
    """The goal of a function with these parameters, for type checkers.

    At run time it is an object with the parameters as its fields: see `FunctionAction.goal_of`.
    """

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Do nothing: the signature says which arguments there are."""


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


class Answers(Protocol[FeedbackT_co, ResultT_co]):
    """An action, by the types of its feedback and its result."""

    @property
    def feedback(self) -> Decodes[FeedbackT_co]:
        """The codec of the feedback."""
        ...

    @property
    def result(self) -> Decodes[ResultT_co]:
        """The codec of the result."""
        ...


class CalledAction(Answers[FeedbackT_co, ResultT_co], Protocol[T_contra, FeedbackT_co, ResultT_co]):
    """An action, by the types of its goal, its feedback and its result."""

    @property
    def goal(self) -> Encodes[T_contra]:
        """The codec of the goal."""
        ...


class TakesArguments(Answers[FeedbackT_co, ResultT_co], Protocol[P, FeedbackT_co, ResultT_co]):
    """An action of a function with these parameters.

    Unlike the class, it is covariant in the result: mypy asks for an `object` in `print(...)`.
    """

    @property
    def goal(self) -> Decodes[Arguments[P]]:
        """The codec of the goal."""
        ...


class OneArgument(Protocol[T_contra]):
    """`Arguments` that one argument is enough for."""

    def __call__(self, first: T_contra, /) -> None:
        """Take it."""
        ...


class NoArgument(Protocol):
    """`Arguments` that need not be given."""

    def __call__(self) -> None:
        """Take none."""
        ...


class TakesOne(Answers[FeedbackT_co, ResultT_co], Protocol[T_contra, FeedbackT_co, ResultT_co]):
    """An action of a function that can be called with one argument."""

    @property
    def goal(self) -> Decodes[OneArgument[T_contra]]:
        """The codec of the goal."""
        ...


class TakesNone(Answers[FeedbackT_co, ResultT_co], Protocol[FeedbackT_co, ResultT_co]):
    """An action of a function that can be called without arguments."""

    @property
    def goal(self) -> Decodes[NoArgument]:
        """The codec of the goal."""
        ...


class HasAction(Protocol[T_co]):
    """A client, by its action."""

    @property
    def action(self) -> T_co:
        """The action of the client."""
        ...
