"""The keyword arguments of the transports for agents, for type checkers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypedDict

from fibaction.wire.settings import Limits


class PolicyKeywords(TypedDict, total=False):
    """The keyword arguments with the fields of an `AgentPolicy`."""

    allow: Iterable[str]
    unasked: Iterable[str]
    read_only: bool
    patience: float


class AgentHttpKeywords(PolicyKeywords, total=False):
    """The keyword arguments that an `AgentHttpTransport` has in addition to its address."""

    token: str
    tokens: Mapping[str, str] | None
    limits: Limits | None
