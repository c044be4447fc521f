"""Is each module covered, lines and branches, by its own test file alone?

    python tests/own_coverage.py

So no line depends on a test that lies elsewhere, where nobody who changes the module looks.
"""

from __future__ import annotations

import sys

if __name__ == "__main__" and not sys.flags.safe_path:
    # This folder: its `typing` would hide Python's own.
    sys.path.pop(0)

import ast
import json
import os
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from coverage import Coverage
from coverage.exceptions import NoDataError

ROOT = Path(__file__).resolve().parent.parent
SOURCES = {
    ROOT / "fibaction": ROOT / "tests",
    ROOT / "transports" / "fibaction_transports": ROOT / "tests" / "transports",
}
ELSEWHERE = ROOT / "transports" / "fibaction_transports" / "ros2"  # needs ROS 2: `make test-ros`
EXAMPLES = "20"  # of each property test: enough to reach every line
PROCESSES = 2  # the machines of a CI have as many processors, or more
SECONDS = 120  # many times what the slowest file takes


def modules() -> Iterator[tuple[Path, Path]]:
    """Each module, and its own test file."""
    for source, tests in SOURCES.items():
        for module in sorted(source.rglob("*.py")):
            if module.is_relative_to(ELSEWHERE):
                continue
            if len(ast.parse(module.read_text()).body) > 1:  # more than a docstring
                name = module.stem.strip("_")
                yield module, tests / module.relative_to(source).with_name(f"test_{name}.py")


def shortcoming(module: Path, test: Path, folder: Path) -> str:
    """Run the test file, and say what it leaves out of the module; nothing if it is all reached."""
    if not test.exists():
        return f"there is no {test.relative_to(ROOT)}"
    data = folder / "-".join(module.relative_to(ROOT).parts)
    command = [
        *(sys.executable, "-m", "coverage", "run", "--branch", f"--data-file={data}"),
        *("-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", str(test)),
    ]
    try:
        run = subprocess.run(
            command,
            cwd=ROOT,
            env={**os.environ, "FIBACTION_EXAMPLES": EXAMPLES},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=SECONDS,
        )
    except subprocess.TimeoutExpired:
        return f"{test.relative_to(ROOT)} takes more than {SECONDS} s"
    if run.returncode:
        return f"{test.relative_to(ROOT)} fails:\n{run.stdout}"
    return uncovered(module, data)


def uncovered(module: Path, data: Path) -> str:
    """The lines and branches of a module that were not reached."""
    coverage = Coverage(data_file=data, config_file=str(ROOT / "pyproject.toml"))
    coverage.load()
    report = data.with_suffix(".json")
    try:
        coverage.json_report([str(module)], outfile=str(report))
    except NoDataError:
        return "it is not even imported"
    (found,) = json.loads(report.read_text())["files"].values()
    missing = [str(line) for line in found["missing_lines"]]
    # A branch out of a line that was not reached says nothing new; a negative one is an exit.
    missing += [
        f"{start}->{end if end > 0 else 'exit'}"
        for start, end in found["missing_branches"]
        if start not in found["missing_lines"]
    ]
    return ", ".join(missing)


def main() -> int:
    """Check all modules, and list those that fall short."""
    pairs = list(modules())
    with TemporaryDirectory() as folder, ThreadPoolExecutor(PROCESSES) as pool:
        runs = [pool.submit(shortcoming, *pair, Path(folder)) for pair in pairs]
        found = [run.result() for run in runs]
    for (module, _), missing in zip(pairs, found, strict=True):
        if missing:
            print(f"{module.relative_to(ROOT)}: {missing}")
    failures = sum(map(bool, found))
    print(f"{len(pairs) - failures} of {len(pairs)} modules are covered by their own test file")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
