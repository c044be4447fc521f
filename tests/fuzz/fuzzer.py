"""What the fuzz targets share: the fuzzer with its corpus, and a run whose errors in the log count.

    python -m tests.fuzz.wire -max_total_time=3600    # search; or `web`, `websocket`...
    python -m tests.fuzz.wire -merge=1                # keep what was found

The fuzzer begins with the kept inputs, `tests/fuzz/corpus/TARGET`, and writes what it finds into
`build/fuzz/TARGET`: inputs that reach something new, and `crash-...` for one that fails. A merge
adds those that reach something new to the kept ones, as few and as short as will do. `make test`
gives each kept input to its target once.
"""

from __future__ import annotations

import logging
import os
import shlex
import sys
from collections.abc import Awaitable, Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

import anyio

ROOT = Path(__file__).resolve().parents[2]
CORPUS = Path(__file__).parent / "corpus"
"""The kept inputs, in a folder for each target."""
FOUND = ROOT / "build" / "fuzz"
"""The inputs that the fuzzer finds, in a folder for each target."""


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


def kept(target: str) -> list[Path]:
    """Return the files with the kept inputs of a target."""
    return sorted((CORPUS / target).iterdir())


def command(target: str, options: Sequence[str]) -> list[str]:
    """Return the command of the fuzzer, with the folders of the target unless others are named."""
    # The fuzzer starts itself again for a merge, by a shell.
    words = [f"{shlex.quote(sys.executable)} -m tests.fuzz.{target}", *options]
    if all(option.startswith("-") for option in options):
        folders = [(folder / target).relative_to(ROOT) for folder in (FOUND, CORPUS)]
        if "-merge=1" in options:
            folders.reverse()  # a merge writes into the first one, as any run does
        words += map(str, folders)
    if not any(option.startswith("-artifact_prefix=") for option in options):
        words.append(f"-artifact_prefix={(FOUND / target).relative_to(ROOT)}{os.sep}")
    return words


def fuzz(target: str, one_input: Callable[[bytes], None], *, logs: bool = True) -> None:
    """Give a target random bytes, as the command line says, until it fails or the time is over.

    Without `logs` nothing is logged, which is faster.
    """
    if find_spec("atheris") is None:
        sys.exit("atheris is not installed: `make fuzz` installs it")
    import atheris

    if not logs:
        logging.disable()
    os.chdir(ROOT)
    (FOUND / target).mkdir(parents=True, exist_ok=True)
    atheris.instrument_all()
    atheris.Setup(command(target, sys.argv[1:]), one_input)
    atheris.Fuzz()
