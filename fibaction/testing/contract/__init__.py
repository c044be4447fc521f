"""The contracts of transports and of goal stores, as a plugin of pytest.

Load it in your top `conftest.py`, `pytest_plugins = ["fibaction.testing.contract"]`. Then a module
of tests that says `from fibaction.testing.contract.transports import *` has the tests of all
transports, and needs one fixture, `new_address`. That of a store says
`from fibaction.testing.contract.stores import *`, and needs the fixture `store`.

Override the fixture `exclusions` to skip the tests of what yours cannot keep.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pkgutil import iter_modules

import pytest

TRANSPORTS = sorted(
    f"{__name__}.{module.name}"
    for module in iter_modules(__path__)
    if module.name.startswith("test_")
)
"""The modules with the tests of transports."""

pytest.register_assert_rewrite(*TRANSPORTS, f"{__name__}.stores")

from fibaction.testing.contract.executors import Form, as_generator  # noqa: E402  # rewritten first
from fibaction.testing.contract.reach import (  # noqa: E402
    NewAddress,
    Reach,
    directly,
    through_a_gateway,
)

MARKS = (
    "promise(*names): the promises of fibaction that the test shows",
    "load: many goals or connections at once, or large values",
    "turns: waits for a second or more, or computes for long",
)
WAYS = {"directly": directly, "through a gateway": through_a_gateway}
"""A gateway knows no types, so what it serves is what arrived over another transport."""


def pytest_configure(config: pytest.Config) -> None:
    """Register the marks of the tests."""
    for mark in MARKS:
        config.addinivalue_line("markers", mark)


@pytest.fixture
def exclusions() -> Mapping[str, str]:
    """Return the names of the tests that yours cannot pass, each with the reason."""
    return {}


@pytest.fixture
def form() -> Form:
    """Return the form of the executors: behind the server, no transport can tell it."""
    return as_generator


@pytest.fixture(params=list(WAYS))
def reach(
    request: pytest.FixtureRequest,
    new_address: NewAddress,
    exclusions: Mapping[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> Reach:
    """Return what serves over the transport under test, and connects to it."""
    if (reason := exclusions.get(request.function.__name__)) is not None:
        pytest.skip(reason)
    # Each line is looked for, and the lines of all tests together would be a flood.
    monkeypatch.setattr("fibaction._runtime.log.QUOTA", sys.maxsize)
    return Reach(WAYS[request.param], new_address)
