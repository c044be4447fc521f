"""The pictures of the comparisons, each made from its report alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.tools.drawing import Bar, Panel, Range, Row, bars, ranges

SPREAD = "The thin line is from the lowest round to the highest. A cut bar is far longer."


def picture(report: dict[str, Any]) -> str:
    """Draw an SVG picture of a comparison."""
    return PICTURES[report["comparison"]](report)


def _panels(report: dict[str, Any], row: Callable[[dict[str, Any]], Row]) -> list[Panel[Row]]:
    """Return the ways of a report, with a panel for each group."""
    groups: dict[str, list[Row]] = {}
    for values in report["ways"].values():
        groups.setdefault(values["group"], []).append(row(values))
    return [Panel(title, rows) for title, rows in groups.items()]


def _rates(title: str, what: str) -> Callable[[dict[str, Any]], str]:
    def row(values: dict[str, Any]) -> Bar:
        label, ours = values["label"], values["ours"]
        if "per_second" not in values:
            lost = f"{values['answered']} of {values['of']} answered, in {values['seconds']} s"
            return Bar(label, 0, lost, ours)
        text = f"{values['per_second']:,.0f} /s"
        if values.get("arrived", 1) < 1:
            text += f", {1 - values['arrived']:.0%} lost"
        return Bar(label, values["per_second"], text, ours, (values["low"], values["high"]))

    return lambda report: bars(title, f"{what} {SPREAD}", _panels(report, row))


def _latencies(title: str, which: str) -> Callable[[dict[str, Any]], str]:
    def row(values: dict[str, Any]) -> Range:
        found = values[which]
        points = [found[name] for name in ("p50", "p90", "p99", "p99.9") if found[name]]
        if not points:
            return Range(values["label"], points, "all were lost", values["ours"])
        text = f"{found['p50']:.2g} ms"
        if found["p99"]:
            text += f", p99 {found['p99']:.2g} ms"
        return Range(values["label"], points, text, values["ours"])

    what = "Shorter is better. The dot is the median, the strokes are p90, p99 and p99.9."
    return lambda report: ranges(title, what, _panels(report, row), "ms")


def _memory(report: dict[str, Any]) -> str:
    panels = [
        Panel(
            f"{count:,} active goals",
            [
                Bar(
                    one["label"],
                    one["megabytes"][str(count)],
                    f"{one['megabytes'][str(count)]:,.0f} MB",
                    one["ours"],
                )
                for one in report["ways"].values()
            ],
        )
        for count in report["counts"]
    ]
    what = "Shorter is better. All that is resident of a process, with Python and the libraries."
    return bars("Memory of a process with active goals", what, panels, one_scale=True)


def _start(report: dict[str, Any]) -> str:
    def row(values: dict[str, Any]) -> Bar:
        spread = (values["low"], values["high"])
        taken = values["milliseconds"]
        return Bar(values["label"], taken, f"{taken:,.0f} ms", values["ours"], spread)

    what = "Shorter is better. The processor's time; the thin line: lowest to highest round."
    return bars("Start of a program", what, _panels(report, row))


PICTURES: dict[str, Callable[[dict[str, Any]], str]] = {
    "goals": _rates("Goals, one after another", "Goals per second: longer is better."),
    "goals_at_once": _rates("Goals, 500 at once", "Goals per second: longer is better."),
    "feedback": _rates(
        "Feedback of one goal, as quickly as can be", "Messages per second: longer is better."
    ),
    "goal_latency": _latencies("From the sending of a goal to its result", "ended"),
    "feedback_latency": _latencies("From the yield of a feedback message to its reader", "seen"),
    "memory": _memory,
    "start": _start,
}
