"""Goals and feedback of a function beside those of a generator, in one process and over TCP.

    python -m tests.tools.benchmarks.functions [--rounds N] [--write]

Each has a process with both ends. They do the same in turns, and the time is the processor's. Each
round has one ratio, so a machine that is busy for a while changes both. `--write` puts the table
into docs/comparisons.md.
"""

from __future__ import annotations

from statistics import median

from tests.support.page_parts import markdown_table
from tests.tools.benchmarks.pages import run
from tests.tools.benchmarks.versions import Version, compare

PLACES = {"inproc": "in one process", "tcp": "tcp"}
KINDS = {
    "goals": "goals, one after another",
    "batches": "goals, 500 at once",
    "feedback": "feedback",
}
FORMS = {"generator": Version(), "function": Version(options=("--function",))}


async def measure(rounds: int) -> str:
    """Return the table for the page."""
    rows: list[list[str]] = []
    for order, ratios in (await compare(FORMS, rounds)).items():
        where, _, work = order.partition(" ")
        found = ratios["function"]
        between = f"{min(found):.2f} and {max(found):.2f}"
        rows.append([f"{PLACES[where]}, {KINDS[work]}", f"{median(found):.2f}", between])
    return markdown_table(
        ["A function, as a part of a generator", "Median", "Rounds between"], rows
    )


if __name__ == "__main__":
    run("functions", measure, rounds=30)
