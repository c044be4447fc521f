"""What ty and pyrefly say of calls of functions: `python -m tests.typing.other_checkers`.

mypy and pyright read tests/typing/functions.py itself, where a comment marks each line that is
wrong. These two read it without such comments, and must find nothing in any other line. What they
must find are the calls of `goal_of`: they are young, and let some other wrong lines pass.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

PROGRAM = Path(__file__).with_name("functions.py")
MARK = re.compile(r"  # type: ignore.*")
ROOT = PROGRAM.parents[2]
CHECKERS = {
    "ty": ("ty", "check", "--output-format=concise", "--python", sys.executable),
    "pyrefly": ("pyrefly", "check", "--preset=default", "--output-format=min-text"),
}


def wrong_lines(checker: str, program: Path) -> dict[int, str]:
    """Return what a checker says, by the number of the line."""
    command, *options = CHECKERS[checker]
    done = subprocess.run(
        [Path(sys.executable).with_name(command), *options, program.name],
        cwd=program.parent,
        capture_output=True,
        text=True,
        timeout=300,
    )
    if not done.stdout.strip():
        raise SystemExit(f"{checker} says nothing: {done.stderr}")
    lines = re.finditer(rf".*{re.escape(program.name)}:(\d+):.*", done.stdout)
    return {int(line[1]): line[0] for line in lines}


def main() -> None:
    lines = PROGRAM.read_text().splitlines()
    marked = {number for number, line in enumerate(lines, 1) if MARK.search(line)}
    goals = {number for number in marked if ".goal_of(" in lines[number - 1]}
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, PROGRAM.name)
        program.write_text("\n".join(MARK.sub("", line) for line in lines) + "\n")
        paths = [f'"{ROOT}"', f'"{ROOT / "transports"}"']
        Path(folder, "pyrefly.toml").write_text(
            f'search-path = [{", ".join(paths)}]\npython-interpreter-path = "{sys.executable}"\n'
        )
        for checker in CHECKERS:
            found = wrong_lines(checker, program)
            false = [text for number, text in found.items() if number not in marked]
            if false or not goals <= found.keys():
                missed = [lines[number - 1].strip() for number in sorted(goals - found.keys())]
                raise SystemExit("\n".join([f"{checker} is wrong in:", *false, *missed]))


if __name__ == "__main__":
    main()
