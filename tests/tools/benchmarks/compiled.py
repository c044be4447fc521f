"""This version with its most used modules compiled by mypyc, in a folder, to be compared.

    python -m tests.tools.benchmarks.compiled ../compiled
    python -m tests.tools.benchmarks.versions ../compiled

They are the modules of a goal's way over the wire that work when mypyc compiles them as they are.
Others have what it does not support: weak references, classes with several bases, `del` of an
attribute.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from tests.support.json_program import ROOT

MODULES = [
    "fibaction/_runtime/notify.py",
    "fibaction/server/admission/admission.py",
    "fibaction/server/registry/kept_results.py",
    "fibaction/server/registry/goal_record.py",
    "fibaction/server/registry/registry.py",
    "fibaction/server/execution/runs.py",
    "fibaction/wire/frames.py",
    "fibaction/wire/link.py",
    "fibaction/wire/client/open_calls.py",
    "fibaction/wire/server/session_goals.py",
    "fibaction/wire/server/subscriptions.py",
]


def copy_to(folder: Path) -> None:
    """Copy the code of this version into a new folder."""
    ignored = shutil.ignore_patterns("__pycache__", "*.so")
    for name in ("fibaction", "transports"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)


def compile_in(folder: Path) -> None:
    """Compile the modules in a folder; each becomes an extension beside its source."""
    mypyc = Path(sys.executable).with_name("mypyc")
    for module in MODULES:
        subprocess.run([mypyc, "--ignore-missing-imports", module], cwd=folder, check=True)


def main(*words: str) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.compiled")
    parser.add_argument("folder", type=Path, help="a folder that does not exist yet")
    folder = parser.parse_args(words or None).folder.resolve()
    if folder.exists():
        parser.error(f"{folder} exists already: name a new folder, or remove it")
    copy_to(folder)
    compile_in(folder)
    print(f"{len(MODULES)} modules are compiled in {folder}")


if __name__ == "__main__":
    main()
