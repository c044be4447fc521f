"""Check of the types of every program in the documentation, by mypy and by basedpyright.

    python -m tests.typing.pages [FOLDER]

The blocks of each program are written below FOLDER (build/pages), one after another into one file
as `tests/test_docs.py` runs them, and the files that the reader is to write beside it. Programs
that are not run are left out. The exit code is 1 if a checker finds fault.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

from tests.support.pages import NOT_RUN, blocks_of, programs_of
from tests.support.walks import file_of

ROOT = Path(__file__).resolve().parent.parent.parent
FOLDER = ROOT / "build" / "pages"
PROGRAMS = "page_{}.py"
STUBS = FOLDER.parent / "page_stubs"
NOT_INSTALLED = ["psycopg"]
"""Libraries of pages that the checks do not install: all their names are `Any`."""


def pages() -> Iterator[Path]:
    """Yield the pages with programs."""
    yield ROOT / "README.md"
    yield ROOT / "transports" / "README.md"
    yield from sorted((ROOT / "docs").rglob("*.md"))


def write(page: str, folder: Path, name: str) -> bool:
    """Write the blocks of a program into a folder; return true if there is one."""
    code = ""
    written = False
    for block in blocks_of(page):
        marked = file_of(block)
        if block.language != "python" or NOT_RUN.search(block.before):
            continue
        if marked is None:
            # The lines have the numbers that they have on the page.
            code += "\n" * (block.line - code.count("\n")) + block.code
        elif not marked["ros"]:
            path = folder / marked["path"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.code, encoding="utf-8")
            written = True
    if code:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / PROGRAMS.format(name)).write_text(code, encoding="utf-8")
    return bool(code) or written


def write_all(folder: Path) -> list[Path]:
    """Write the programs of all pages, and return the folder of each."""
    shutil.rmtree(folder, ignore_errors=True)
    folders: list[Path] = []
    for page in pages():
        for number, part in enumerate(programs_of(page.read_text(encoding="utf-8")), start=1):
            name = "_".join((*page.relative_to(ROOT).with_suffix("").parts, str(number)))
            if write(part, folder / name, name):
                folders.append(folder / name)
    return folders


def run_mypy(folders: list[Path]) -> bool:
    """Run mypy, at once on the pages without files of their own; return true if all is well."""
    alone = [folder for folder in folders if [*folder.rglob("*.py")] == [*folder.glob("page_*.py")]]
    with_files = [folder for folder in folders if folder not in alone]
    runs = [alone, *([folder] for folder in with_files)]
    # With other settings than those of the code, mypy would check what the pages import once more.
    of_the_code = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mypy"]
    settings = FOLDER.parent / "pages_mypy.ini"
    settings.write_text(
        f"[mypy]\nstrict = true\nmypy_path = {ROOT}:{ROOT / 'transports'}:{STUBS}\n"
        "exclude_gitignore = false\n"
        f"enable_error_code = {', '.join(of_the_code['enable_error_code'])}\n"
        "[mypy-roslibpy.*]\nignore_missing_imports = true\n",
        encoding="utf-8",
    )
    well = True
    for run in runs:
        files = [str(path) for folder in run for path in sorted(folder.rglob("*.py"))]
        command = [sys.executable, "-m", "mypy", "--config-file", str(settings), *files]
        cwd = run[0] if len(run) == 1 else ROOT
        cache = ["--cache-dir", str(ROOT / ".mypy_cache")]
        well &= subprocess.run([*command, *cache], cwd=cwd, check=False).returncode == 0
    return well


def run_pyright(folders: list[Path]) -> bool:
    """Run basedpyright, and return true if all is well."""
    settings = {
        "include": [str(folder) for folder in folders],
        "executionEnvironments": [
            {"root": str(folder), "extraPaths": [str(ROOT), str(ROOT / "transports")]}
            for folder in folders
        ],
        "stubPath": str(STUBS),
        "reportMissingModuleSource": "none",  # of `NOT_INSTALLED`
        "typeCheckingMode": "standard",
        "pythonVersion": "3.11",
    }
    path = FOLDER.parent / "pages_pyright.json"
    path.write_text(json.dumps(settings), encoding="utf-8")
    command = [sys.executable, "-m", "basedpyright", "--project", str(path)]
    command += ["--pythonpath", sys.executable]
    return subprocess.run(command, check=False).returncode == 0


if __name__ == "__main__":
    STUBS.mkdir(parents=True, exist_ok=True)
    for library in NOT_INSTALLED:
        stub = "from typing import Any\n\ndef __getattr__(name: str) -> Any: ...\n"
        (STUBS / f"{library}.pyi").write_text(stub, encoding="utf-8")
    written = write_all(FOLDER)
    print(f"{len(written)} programs of pages", flush=True)
    sys.exit(0 if run_mypy(written) & run_pyright(written) else 1)
