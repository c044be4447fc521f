"""What the fuzz targets share: the fuzzer, and a run whose errors in the log count."""

from __future__ import annotations

import logging
import sys
from collections.abc import Awaitable, Callable
from importlib.util import find_spec

import anyio


class _Errors(logging.Handler):
    """The errors in the log."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.found.append(self.format(record))


def run_without_errors(serve: Callable[[bytes], Awaitable[None]], data: bytes) -> None:
    """Serve a peer that sends these bytes; an error in the log is a finding."""
    errors, logger = _Errors(), logging.getLogger("fibaction")
    logger.addHandler(errors)
    try:
        anyio.run(serve, data)
    finally:
        logger.removeHandler(errors)
    assert not errors.found, errors.found[0]


def fuzz(one_input: Callable[[bytes], None], *, logs: bool = True) -> None:
    """Give a target random bytes, as the command line says, until it fails or the time is over.

    Without `logs` nothing is logged, which is faster.
    """
    if find_spec("atheris") is None:
        sys.exit("atheris is not installed: `make fuzz` installs it")
    import atheris

    if not logs:
        logging.disable()
    atheris.instrument_all()
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
