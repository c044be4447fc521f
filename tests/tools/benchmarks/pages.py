"""The tables of docs/comparisons.md."""

from __future__ import annotations

import argparse
from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from typing import Any

import anyio

from tests.support.json_program import ROOT
from tests.support.page_parts import markdown_table, with_part

PAGE = ROOT / "docs" / "comparisons.md"
NOTHING = "–"  # noqa: RUF001  # the dash that tables show for a missing number


def run(name: str, measure: Callable[..., Awaitable[str]], **options: int) -> None:
    """Run a program that measures, with these options and their defaults, and print its table;
    `--write` puts it into the part of the page that has the program's name.
    """
    command = f"python -m tests.tools.benchmarks.{name}"
    parser = argparse.ArgumentParser(prog=command)
    for option, default in options.items():
        parser.add_argument(f"--{option}", type=int, default=default)
    parser.add_argument("--write", action="store_true")
    given = vars(parser.parse_args())
    is_written = given.pop("write")
    made = anyio.run(partial(measure, **given))
    print(made)
    if is_written:
        page = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(with_part(page, name, command, made), encoding="utf-8")


def with_tables(page: str, reports: dict[str, dict[str, Any]]) -> str:
    """Return the page, with the parts between its markers made anew.

    Raises:
        ValueError: A pair of markers is missing.
    """
    parts = {name: table(report) for name, report in reports.items()}
    # A peer that was left out during the run is named in the later reports only.
    parts["machine"] = machine(max(reports.values(), key=lambda one: len(one["left_out"])))
    parts["losses"] = losses(reports)
    for name, text in parts.items():
        page = with_part(page, name, "make bench", text)
    return page


def table(report: dict[str, Any]) -> str:
    """Return the text below the heading of a comparison: picture, numbers, and peers left out."""
    name = report["comparison"]
    title, rows, last = TABLES[name]
    parts = [f"![{title}; the table says the same](benchmarks/{name}.svg)", rows(report)]
    if report["ratios"]:
        parts.append(_ratios(report, last))
    return "\n\n".join(parts)


def machine(report: dict[str, Any]) -> str:
    """Return the machine, the versions, the date and the command of a run, and peers left out."""
    on = report["machine"]
    rows = [
        ["Command", f"`{report['command']}`"],
        ["Date", report["date"]],
        [
            "Machine",
            f"{on['processor']}, {on['cores']} cores, {on['memory_gigabytes']} GB, {on['system']}",
        ],
        ["Load when it began", f"{on['load_at_start']:g}"],
        ["Versions", ", ".join(f"{name} {what}" for name, what in report["versions"].items())],
    ]
    lines = [markdown_table(["", ""], rows, numbers=False)]
    lines += [f"Left out is {label}: {reason}." for label, reason in report["left_out"].items()]
    return "\n\n".join(lines)


def losses(reports: dict[str, dict[str, Any]]) -> str:
    """Return every ratio in which fibaction is slower than a peer."""
    lines: list[str] = []
    for name, (title, _, what) in TABLES.items():
        report = reports[name]
        for one in report["ratios"]:
            ours, peer = report["ways"][one["of"]], report["ways"][one["to"]]
            is_slower = one["median"] > 1 if what == SHORTER else one["median"] < 1
            if is_slower and not peer["ours"]:
                of = "the time" if what == SHORTER else "the rate"
                lines.append(
                    f"- {title}: {ours['label']} has {one['median']:g} of {of} of {peer['label']}"
                    f" ({one['low']:g} to {one['high']:g})."
                )
    return "\n".join(lines) or "In none of the ratios."


def _ratios(report: dict[str, Any], what: str) -> str:
    labels = {key: values["label"] for key, values in report["ways"].items()}
    rows = [
        [
            f"{labels[one['of']]}, to {labels[one['to']]}",
            f"{one['median']:g}",
            f"{one['low']:g} to {one['high']:g}",
        ]
        for one in report["ratios"]
    ]
    return markdown_table([what, "Median of the rounds", "Lowest and highest"], rows)


def _by_group(report: dict[str, Any]) -> Iterable[tuple[str, dict[str, Any]]]:
    """Yield the label of each way, as tables show it, and its numbers."""
    for values in report["ways"].values():
        yield (f"**{values['label']}**" if values["ours"] else values["label"]), values


def _rates(report: dict[str, Any]) -> str:
    rows = []
    of_feedback = report["comparison"] == "feedback"
    for label, values in _by_group(report):
        if "per_second" not in values:
            lost = f"{values['answered']} of {values['of']} answered in {values['seconds']} s"
            rows.append([label, lost, NOTHING])
            continue
        row = [label, f"{values['per_second']:,.0f}"]
        row.append(f"{values['low']:,.0f} to {values['high']:,.0f}")
        if of_feedback:
            row += [f"{values['at_once']:,}", f"{values['arrived']:.0%}"]
        rows.append(row)
    head = ["", "Per second", "Lowest and highest round"]
    return markdown_table(head + (["Messages of a goal", "Arrived"] if of_feedback else []), rows)


def _percentiles(found: dict[str, Any] | None) -> list[str]:
    if found is None:
        return [NOTHING] * 4
    of = (found[name] for name in ("p50", "p90", "p99", "p99.9"))
    return [NOTHING if one is None else f"{one:.3g}" for one in of]


def _goal_latencies(report: dict[str, Any]) -> str:
    head = ["Milliseconds to the result", "p50", "p90", "p99", "p99.9", "Goals"]
    ended = [
        [label, *_percentiles(values["ended"]), f"{values['ended']['samples']:,}"]
        for label, values in _by_group(report)
    ]
    accepted = [
        [label, *_percentiles(values["accepted"])]
        for label, values in _by_group(report)
        if values["accepted"]
    ]
    return "\n\n".join(
        (
            markdown_table(head, ended),
            markdown_table(["Milliseconds to the acceptance", *head[1:5]], accepted),
        )
    )


def _feedback_latencies(report: dict[str, Any]) -> str:
    head = ["Milliseconds", "p50", "p90", "p99", "p99.9", "Messages"]
    rows = [
        [label, *_percentiles(values["seen"]), f"{values['seen']['samples']:,}"]
        for label, values in _by_group(report)
    ]
    return markdown_table(head, rows)


def _memory(report: dict[str, Any]) -> str:
    rows = []
    for label, values in _by_group(report):
        each_result = values["kilobytes_each_result"]
        rows.append(
            [
                label,
                *(f"{size:,.0f} MB" for size in values["megabytes"].values()),
                f"{values['kilobytes_each_goal']:.1f} kB",
                NOTHING if each_result is None else f"{each_result:.2f} kB",
            ]
        )
    head = ["", *(f"{count:,} active" for count in report["counts"])]
    most = report["counts"][-1]
    server = report["ways"]["tcp_server"]["megabytes"][str(most)]
    made = markdown_table([*head, "Each goal", "Each kept result"], rows)
    return (
        f"{made}\n\nThe server of `tcp://` has {server:,.0f} MB with {most:,} active goals;"
        f" the aim is less than {report['aim_megabytes']} MB with 10,000."
    )


def _start(report: dict[str, Any]) -> str:
    rows = [
        [
            f"{label}, in {values['group'][0].lower()}{values['group'][1:]}",
            f"{values['milliseconds']}",
            f"{values['low']} to {values['high']}",
        ]
        for label, values in _by_group(report)
    ]
    return markdown_table(["", "Milliseconds", "Lowest and highest"], rows)


FASTER, SHORTER = "Rate (more than 1: faster)", "Median (less than 1: shorter)"

TABLES: dict[str, tuple[str, Callable[[dict[str, Any]], str], str]] = {
    "goals": ("Goals per second, one after another", _rates, FASTER),
    "goals_at_once": ("Goals per second, 500 at once", _rates, FASTER),
    "feedback": ("Feedback messages per second", _rates, FASTER),
    "goal_latency": ("How long a goal takes", _goal_latencies, SHORTER),
    "feedback_latency": ("How long a feedback message takes", _feedback_latencies, SHORTER),
    "memory": ("Memory of a process with active goals", _memory, ""),
    "start": ("The processor's time that a start takes", _start, ""),
}
"""For each comparison: the subject of its picture, its table, and the subject of its ratios."""
