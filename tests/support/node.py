"""Node, and the libraries of JavaScript of the tests: where they are, and programs that use them.

`make unit` installs the libraries into `build/javascript`, at the versions that
`tests/javascript/package-lock.json` names.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

from tests.support.processes import Finished, ended

MODULES = Path(__file__).resolve().parents[2] / "build" / "javascript" / "node_modules"
"""The folder of the installed libraries."""
LEAST = 20
"""The oldest Node that the libraries run in."""
PROGRAM = shutil.which("node")
"""The path of Node; None if it is not installed."""
IS_REQUIRED = os.environ.get("FIBACTION_NODE") == "required"
"""True in the check of the project, which skips none of these tests."""


def _missing() -> str:
    """Return what is missing, as the reason of a skip; empty if nothing is."""
    if PROGRAM is None:
        return "Node is not installed"
    version = subprocess.run([PROGRAM, "--version"], capture_output=True, text=True).stdout
    found = re.match(r"v(\d+)", version)
    if found is None or int(found[1]) < LEAST:
        return f"Node is {version.strip()}, and {LEAST} is the least"
    if not MODULES.is_dir():
        return "libraries of JavaScript are not installed: run `make unit`"
    return ""


MISSING = _missing()
"""What is missing, as the reason of a skip; empty if nothing is."""
IS_LEFT_OUT = bool(MISSING) and not IS_REQUIRED
"""True if tests with Node are skipped; the check of the project requires them."""


def start_node(folder: Path, program: str, *arguments: str) -> subprocess.Popen[str]:
    """Start an ES module, in a folder of its own in which it finds the libraries."""
    assert PROGRAM is not None, MISSING
    assert not MISSING, MISSING
    libraries = folder / "node_modules"
    if not libraries.exists():
        libraries.symlink_to(MODULES)
    path = folder / "program.mjs"
    path.write_text(program)
    return subprocess.Popen(
        [PROGRAM, str(path), *arguments],
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run_node(folder: Path, program: str, *arguments: str) -> Finished:
    """Run an ES module to its end; see `start_node`."""
    return ended(start_node(folder, program, *arguments))
