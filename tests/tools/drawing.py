"""Bars and ranges as SVG pictures, on white, so that they can be read on dark pages, too."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from html import escape
from typing import Generic, NamedTuple, TypeVar

WIDTH = 760
MARGIN, LABELS, NUMBERS = 24, 236, 192
"""The left edge of the labels, that of the bars, and the room behind the longest bar."""
LONGEST = WIDTH - LABELS - NUMBERS
TITLE, SUBTITLE, PANEL, ROW, BAR, FOOT = 44, 20, 34, 26, 16, 34
"""The heights of the parts that stand below one another."""
FAR, BEYOND = 8, 1.4
"""The ratio to the next longest bar from which a bar is cut off, and the one to which it is cut."""
OURS, OTHERS, INK, PALE = "#1f56b3", "#93a0ad", "#1d2733", "#5b6672"


class Bar(NamedTuple):
    label: str
    value: float
    """The length; 0 draws only the text."""
    text: str
    is_ours: bool
    spread: tuple[float, float] | None = None
    """The lowest and the highest value."""


class Range(NamedTuple):
    label: str
    points: Sequence[float]
    """The values in order; the first is drawn as a dot, the others as strokes behind it."""
    text: str
    is_ours: bool


Row = TypeVar("Row", Bar, Range)


class Panel(NamedTuple, Generic[Row]):
    """Rows that belong together."""

    title: str
    rows: Sequence[Row]


def bars(
    title: str, subtitle: str, panels: Sequence[Panel[Bar]], *, one_scale: bool = False
) -> str:
    """Draw bars that begin at zero, with a scale for each panel, or `one_scale` for all."""
    of_all = _top([row for panel in panels for row in panel.rows])
    drawn = [
        (
            panel.title,
            [list(_bar(row, of_all if one_scale else _top(panel.rows))) for row in panel.rows],
        )
        for panel in panels
    ]
    return _picture(title, subtitle, drawn)


def ranges(title: str, subtitle: str, panels: Sequence[Panel[Range]], unit: str) -> str:
    """Draw ranges on one logarithmic scale, with a line at each power of ten."""
    values = [point for panel in panels for row in panel.rows for point in row.points]
    low = math.floor(math.log10(min(values)))
    high = math.ceil(math.log10(max(values)))

    def place(value: float) -> float:
        return LABELS + LONGEST * (math.log10(value) - low) / max(1, high - low)

    drawn = [
        (panel.title, [list(_range(row, place, low, high)) for row in panel.rows])
        for panel in panels
    ]
    scale = [
        f'<text class="note" text-anchor="middle" x="{place(10.0**power):.1f}" y="4">'
        f"{10.0**power:g} {unit}</text>"
        for power in range(low, high + 1)
    ]
    return _picture(title, subtitle, [*drawn, ("", [scale])])


def _top(rows: Sequence[Bar]) -> float:
    """Return the value of the longest bar.

    A bar that is much longer than all others is cut off, so that the others can be told apart.
    """
    lengths = sorted(max(row.value, *(row.spread or (0,))) for row in rows)
    if len(lengths) > 1 and lengths[-1] > FAR * lengths[-2] > 0:
        return lengths[-2] * BEYOND
    return lengths[-1] or 1


def _bar(row: Bar, top: float) -> Iterator[str]:
    """Draw one row, with its middle at 0."""
    scale = LONGEST / top
    is_cut = row.value > top
    length = min(row.value * scale, LONGEST)
    end = LABELS + length
    yield _text(row.label, row.is_ours, f"{MARGIN}")
    if length:
        color = OURS if row.is_ours else OTHERS
        yield (
            f'<rect x="{LABELS}" y="{-BAR / 2:g}" width="{max(length, 1):.1f}" height="{BAR}"'
            f' rx="2" fill="{color}"/>'
        )
    if is_cut:
        x = LABELS + LONGEST - 40
        yield f'<path d="M{x},12 l8,-24 h7 l-8,24 z" fill="#ffffff"/>'
    elif row.spread:
        low, high = (LABELS + min(value * scale, LONGEST) for value in row.spread)
        line = f"M{low:.1f},0 H{high:.1f} M{low:.1f},-4 v8 M{high:.1f},-4 v8"
        yield f'<path class="spread" d="{line}"/>'
        end = max(end, high)
    yield _text(row.text, row.is_ours, f"{end + 8:.1f}")


def _range(row: Range, place: Callable[[float], float], low: int, high: int) -> Iterator[str]:
    for power in range(low, high + 1):
        yield f'<path class="grid" d="M{place(10.0**power):.1f},{-ROW / 2:g} v{ROW}"/>'
    yield _text(row.label, row.is_ours, f"{MARGIN}")
    color = OURS if row.is_ours else OTHERS
    places = [place(point) for point in row.points]
    if len(places) > 1:
        strokes = " ".join(f"M{x:.1f},-6 v12" for x in places[1:])
        path = f"M{places[0]:.1f},0 H{places[-1]:.1f} {strokes}"
        yield f'<path d="{path}" stroke="{color}" stroke-width="2.5" fill="none"/>'
    for x in places[:1]:
        yield f'<circle cx="{x:.1f}" cy="0" r="6" fill="{color}"/>'
    yield _text(row.text, row.is_ours, f"{LABELS + LONGEST + 12:.1f}")


def _text(text: str, is_ours: bool, x: str) -> str:
    kind = "ours" if is_ours else "other"
    return f'<text class="{kind}" x="{x}" y="4.5">{escape(text)}</text>'


def _picture(
    title: str,
    subtitle: str,
    panels: Iterable[tuple[str, list[list[str]]]],
) -> str:
    parts: list[str] = []
    y = float(TITLE + SUBTITLE)
    for heading, rows in panels:
        if heading:
            y += PANEL
            place = f'x="{MARGIN}" y="{y - 10:g}"'
            parts.append(f'<text class="panel" {place}>{escape(heading)}</text>')
        for row in rows:
            middle = y + ROW / 2
            parts.append(f'<g transform="translate(0,{middle:g})">{"".join(row)}</g>')
            y += ROW
    height = round(y + FOOT - 10)
    return "\n".join((*head(title, subtitle, height), *parts, "</svg>")) + "\n"


def head(title: str, subtitle: str, height: int) -> Iterator[str]:
    """Draw what every picture begins with: its frame, its title and the line below."""
    yield (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}"'
        f' height="{height}" role="img" aria-labelledby="title">'
    )
    yield f'<title id="title">{escape(title)}</title>'
    yield (
        "<style>"
        'text { font: 13px system-ui, "Segoe UI", "DejaVu Sans", sans-serif; fill: '
        f"{INK}; }} .title {{ font-size: 16px; font-weight: 600; }} .panel {{ font-weight: 600; }}"
        f" .note {{ font-size: 11.5px; fill: {PALE}; }} .ours {{ font-weight: 600; fill: {OURS}; }}"
        f" .spread {{ stroke: {INK}; stroke-width: 1.2; fill: none; }}"
        " .grid { stroke: #e3e8ed; stroke-width: 1; }"
        "</style>"
    )
    yield (
        f'<rect x="0.5" y="0.5" width="{WIDTH - 1}" height="{height - 1}" rx="12" fill="#ffffff"'
        ' stroke="#d5dbe1"/>'
    )
    yield f'<text class="title" x="{MARGIN}" y="32">{escape(title)}</text>'
    yield f'<text class="note" x="{MARGIN}" y="52">{escape(subtitle)}</text>'
