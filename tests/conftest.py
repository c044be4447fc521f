"""The settings of all tests: hypothesis, Ctrl-C, and a check that tests leave the log unchanged."""

from __future__ import annotations

import gc
import logging
import os
import random
import signal
import sys
from collections.abc import Generator, Iterator

import pytest
from hypothesis import HealthCheck, settings

from fibaction._runtime import log
from tests.tools import second_try
from tests.tools.elsewhere import Elsewhere

settings.register_profile(
    "fibaction",
    # `make properties`, each night, asks for a thousand; `make test-pythons` and `make test-lowest`
    # for few: they look for what another version of Python or of a library does otherwise.
    max_examples=int(os.environ.get("FIBACTION_EXAMPLES", "50")),
    # Machines that run tests are shared: time says nothing about the code.
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=False,
    print_blob=True,  # so that an example that is found can be replayed
)
settings.load_profile("fibaction")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Background processes inherit this from shells; programs that tests start would ignore a
    # Ctrl-C, too.
    signal.signal(signal.SIGINT, signal.default_int_handler)


WORKER = os.environ.get("PYTEST_XDIST_WORKER")
"""The name of this process among those of pytest-xdist."""

# The lines of all tests together would be a flood: each is written, but in the tests of that limit.
log.QUOTA = sys.maxsize


def pytest_configure(config: pytest.Config) -> None:
    """Let failed tests that start processes have a second try, where `.ci/run` asks for it."""
    second_try.register(config)
    if "FIBACTION_ELSEWHERE" in os.environ and "PYTEST_CURRENT_TEST" not in os.environ:
        config.pluginmanager.register(Elsewhere(config))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect no garbage while tests are collected: nearly all that is made then stays."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Let each process of pytest-xdist import the test files in an order of its own.

    pytest keeps the code that it makes of a file. In the same order, all processes would make that
    of each file at the same time.
    """
    report = yield
    if WORKER is not None and isinstance(collector, pytest.Directory):
        random.Random(WORKER).shuffle(report.result)
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of all processes in the same order, that of their paths."""
    if WORKER is not None:
        parts = {path: path.parts for path in {item.path for item in items}}
        items.sort(key=lambda item: parts[item.path])


def _levels() -> dict[str, int]:
    """Return the level of each logger, and the level that is disabled for all."""
    loggers = {"": logging.getLogger(), **logging.root.manager.loggerDict}
    levels = {name: one.level for name, one in loggers.items() if isinstance(one, logging.Logger)}
    return {"all": logging.root.manager.disable, **levels}


@pytest.fixture(autouse=True)
def log_is_left_as_it_was() -> Iterator[None]:
    """Check that a test leaves the log levels unchanged, since later tests may look for a line."""
    before = _levels()
    yield
    after = _levels()
    changed = {name: after.get(name) for name, level in before.items() if after.get(name) != level}
    assert changed == {}  # modules imported for the first time may add loggers


@pytest.fixture(autouse=True, scope="module")
def what_stays_is_spared() -> None:
    """Spare what stays to the end, modules and tests, the collections of garbage in a file.

    Many tests collect garbage, so that what they leave open is found there. With some 14,000 tests
    in memory each collection takes 0.4 s. It is done for each file, since some tests undo it.
    """
    gc.collect()
    gc.freeze()
