"""The tables and the picture of docs/shown_to_hold.md, of what `sizes` has measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from tests.support.json_program import ROOT
from tests.support.page_parts import markdown_table, with_part
from tests.tools.benchmarks.pages import NOTHING
from tests.tools.drawing import Bar, Panel, bars

PAGE = ROOT / "docs" / "shown_to_hold.md"
FOLDER = ROOT / "docs" / "benchmarks" / "sizes"
MAKER = "python -m tests.tools.benchmarks.sizes"


class Series(NamedTuple):
    """Figures of one kind, one for each size."""

    name: str
    unit: str
    values: Sequence[float | None]


class Direction(NamedTuple):
    """The figures of one direction."""

    name: str
    of: str
    """The things of which there are more and more."""
    sizes: Sequence[int]
    series: Sequence[Series]
    shown: int = 0
    """The series that the picture shows, whose figures are the same as long as the line of the
    costs is straight."""


class Report(NamedTuple):
    """The figures of a run, with its machine and its date."""

    machine: str
    date: str
    directions: Sequence[Direction]


def figure(value: float) -> str:
    """Return a number with three digits at most before it becomes longer."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def size_text(of: str, size: int) -> str:
    """Return a size as people say it; bytes have prefixes."""
    if of != "bytes":
        return f"{size:,}"
    for unit, factor in (("MB", 10**6), ("kB", 10**3)):
        if size >= factor:
            return f"{size / factor:g} {unit}"
    return f"{size} B"


def label(of: str, size: int) -> str:
    """Return the name of a size: so many of something."""
    if of == "bytes":
        return size_text(of, size)
    return f"{size_text(of, size)} {of.removesuffix('s') if size == 1 else of}"


def table(direction: Direction) -> str:
    """Return the figures of a direction as a table."""
    sizes = [size_text(direction.of, size) for size in direction.sizes]
    of = "Payload" if direction.of == "bytes" else direction.of.capitalize()
    rows: list[list[str]] = []
    for name, unit, values in direction.series:
        cells = [NOTHING if value is None else f"{figure(value)} {unit}" for value in values]
        known = [value for value in values if value is not None]
        ratio = f"{known[-1] / known[0]:.3g}" if known else NOTHING
        rows.append([name, *cells, ratio])
    return markdown_table([of, *sizes, "Last to first"], rows)


def picture(report: Report) -> str:
    """Draw what one costs at each size."""
    panels = []
    for _, of, sizes, series, shown in report.directions:
        name, unit, values = series[shown]
        labels = [label(of, size) for size in sizes]
        rows = [
            Bar(text, value, f"{figure(value)} {unit}", True)
            for text, value in zip(labels, values, strict=True)
            if value is not None
        ]
        panels.append(Panel(name, rows))
    what = "Each panel has its own scale: with bars of one length, costs grow as the size does."
    return bars("What one costs, of few and of many", what, panels)


def read() -> Report:
    """Return what was measured last."""
    return msgspec.json.decode((FOLDER / "report.json").read_bytes(), type=Report)


def page_of(page: str, report: Report) -> str:
    """Return the page with the tables of a report.

    Raises:
        ValueError: It has no part for a table.
    """
    page = with_part(page, "machine", MAKER, f"Measured on {report.date}: {report.machine}.")
    for direction in report.directions:
        page = with_part(page, direction.name, MAKER, table(direction))
    return page


def write(report: Report) -> None:
    """Put the tables into the page, and the picture beside it."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / "report.json").write_bytes(msgspec.json.format(msgspec.json.encode(report)) + b"\n")
    (FOLDER / "sizes.svg").write_text(picture(report), encoding="utf-8")
    PAGE.write_text(page_of(PAGE.read_text(encoding="utf-8"), report), encoding="utf-8")
