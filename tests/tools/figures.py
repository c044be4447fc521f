"""The figures of docs/shown_to_hold.md: `python -m tests.tools.figures` makes the page and its
pictures again from the reports in docs/figures, which `make soak` and `make mutants` write.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.support.page_parts import markdown_table, with_part
from tests.tools.curves import Curve, Panel, curves

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "figures"
PAGE = ROOT / "docs" / "shown_to_hold.md"
CORPUS = ROOT / "tests" / "fuzz" / "corpus"
SOAKS = {"soak": "alone", "soak_beside_load": "under load"}
"""The reports of soaks, each with its name on the page."""
MUTANTS = "mutants"
MEGA = 1e6
ENDS = {"server": "server", "client": "clients"}
"""The processes of a soak, with their labels."""
ALONE = 0.1
"""The share of the processors' time that other processes may take beside a soak that is alone."""
COUNTED = ("tasks", "files", "threads")


def keep(report: dict[str, Any]) -> None:
    """Write a report, one line for each of its parts, and make the page again."""
    FOLDER.mkdir(exist_ok=True)
    lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(part)}" for key, part in report.items())
    (FOLDER / f"{report['name']}.json").write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
    write()


def read() -> dict[str, dict[str, Any]]:
    """Return the reports, by name."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(FOLDER.glob("*.json"))
    }


def write() -> None:
    """Make the pictures and the parts of the page from the reports."""
    reports = read()
    for name in SOAKS:
        (FOLDER / f"{name}.svg").write_text(picture(reports[name]), encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_parts(page, reports), encoding="utf-8")


def picture(report: dict[str, Any]) -> str:
    """Draw what both processes of a soak used over the time."""
    panels = [
        Panel(
            title,
            [
                Curve(label, [value / size for value in report[end][what]], end == "server")
                for end, label in ENDS.items()
            ],
        )
        for what, title, size in (
            ("memory", "Resident memory, in MB", MEGA),
            ("tasks", "Tasks", 1),
            ("files", "Open files", 1),
            ("threads", "Threads", 1),
        )
    ]
    title = f"{report['connections']} connections over {report['over']}, {SOAKS[report['name']]}"
    goals = f"{report['goals']:,} goals. The figures behind the curves are the last ones."
    at = [seconds / 60 for seconds in report["at"]]
    return curves(title, goals, panels, at, "min")


def with_parts(page: str, reports: dict[str, dict[str, Any]]) -> str:
    """Return the page, with the parts between its markers made anew.

    Raises:
        ValueError: A pair of markers is missing.
    """
    parts = {name: _soak(reports[name]) for name in SOAKS}
    parts |= {"corpus": _corpus(), MUTANTS: _mutants(reports[MUTANTS])}
    for name, text in parts.items():
        page = with_part(page, name, "tests/tools/figures.py", text)
    return page


def _soak(report: dict[str, Any]) -> str:
    name, on = report["name"], report["machine"]
    tenth = len(report["at"]) // 10
    rows = [
        [
            label,
            *(f"{value / MEGA:.1f} MB" for value in report[end]["memory"][tenth - 1 :: 9 * tenth]),
            *(f"{report['before'][end][what]}, {report['after'][end][what]}" for what in COUNTED),
        ]
        for end, label in ENDS.items()
    ]
    head = [
        "",
        "Memory after a tenth",
        "At the end",
        *(f"{what.capitalize()} before, after" for what in COUNTED),
    ]
    versions = ", ".join(f"{what} {number}" for what, number in report["versions"].items())
    made = (
        f"`{report['command']}` made these figures on {report['date']}, in"
        f" {report['seconds']:g} s and {report['goals']:,} goals, on {on['processor']} with"
        f" {on['cores']} cores, with {versions}. {_company(report)}"
    )
    return "\n\n".join(
        (
            f"![What server and clients use over the time, {SOAKS[name]}](figures/{name}.svg)",
            markdown_table(head, rows),
            made,
        )
    )


def _company(report: dict[str, Any]) -> str:
    """Return a sentence about the other work of the machine."""
    others = f"{report['others_share']:.0%} of the processors' time"
    if report["load"]:
        return (
            f"Beside the {report['load']} busy processes that belong to it, other processes of the"
            f" machine took {others}; that of the busy ones is not counted."
        )
    told = f"Other processes of the machine took {others}"
    if report["others_share"] > ALONE:
        return f"{told}: it was alone only as far as it started no load itself."
    return f"{told}."


def _corpus() -> str:
    rows = []
    for folder in sorted(one for one in CORPUS.iterdir() if one.is_dir()):
        sizes = [path.stat().st_size for path in folder.iterdir()]
        rows.append([f"`tests.fuzz.{folder.name}`", f"{len(sizes)}", f"{sum(sizes):,}"])
    return markdown_table(["Target", "Inputs", "Bytes"], rows)


def _mutants(report: dict[str, Any]) -> str:
    rows = [
        [f"`{name}`", *(f"{one[what]:,}" for what in ("mutants", "found"))]
        for name, one in report["modules"].items()
    ]
    return markdown_table(["Module", "Faults tried", "Found by a test"], rows)


if __name__ == "__main__":
    write()
