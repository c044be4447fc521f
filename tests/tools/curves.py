"""Curves over time as SVG pictures, in the style of the bars of `tests.tools.drawing`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from typing import NamedTuple

from tests.tools.drawing import FOOT, MARGIN, OTHERS, OURS, PANEL, SUBTITLE, TITLE, WIDTH, head

LEFT, RIGHT = 64, WIDTH - 150
"""The edges of the curves; the labels are behind the right one."""
HEIGHT = 84
APART = 15.0
"""The distance of two labels at least."""


class Curve(NamedTuple):
    label: str
    values: Sequence[float]
    is_ours: bool


class Panel(NamedTuple):
    """Curves with one scale, which begins at zero."""

    title: str
    curves: Sequence[Curve]


def curves(
    title: str, subtitle: str, panels: Sequence[Panel], at: Sequence[float], unit: str
) -> str:
    """Draw panels one below another, each over the same times `at`."""
    parts: list[str] = []
    y = float(TITLE + SUBTITLE)
    for panel in panels:
        y += PANEL
        place = f'x="{MARGIN}" y="{y - 10:g}"'
        parts.append(f'<text class="panel" {place}>{escape(panel.title)}</text>')
        parts.append(f'<g transform="translate(0,{y:g})">{"".join(_panel(panel, at))}</g>')
        y += HEIGHT
    for time, anchor in ((0.0, LEFT), (at[-1] / 2, (LEFT + RIGHT) / 2), (at[-1], RIGHT)):
        place = f'text-anchor="middle" x="{anchor:g}" y="{y + 18:g}"'
        parts.append(f'<text class="note" {place}>{time:.3g} {unit}</text>')
    height = round(y + FOOT)
    return "\n".join((*head(title, subtitle, height), *parts, "</svg>")) + "\n"


def _panel(panel: Panel, at: Sequence[float]) -> Iterator[str]:
    top = max(1.0, *(value for curve in panel.curves for value in curve.values))

    def place(value: float) -> float:
        return HEIGHT * (1 - value / top)

    for value in (0.0, top):
        y = place(value)
        yield f'<path class="grid" d="M{LEFT},{y:.1f} H{RIGHT}"/>'
        spot = f'text-anchor="end" x="{LEFT - 8}" y="{y + 4:.1f}"'
        yield f'<text class="note" {spot}>{value:.3g}</text>'
    for curve in panel.curves:
        points = zip(at, curve.values, strict=True)
        line = " L".join(
            f"{LEFT + (RIGHT - LEFT) * time / at[-1]:.1f},{place(value):.1f}"
            for time, value in points
        )
        color = OURS if curve.is_ours else OTHERS
        yield f'<path d="M{line}" stroke="{color}" stroke-width="1.6" fill="none"/>'
    lowest = float("inf")
    for curve in sorted(panel.curves, key=lambda one: one.values[-1]):
        y = lowest = min(place(curve.values[-1]), lowest - APART)
        kind = "ours" if curve.is_ours else "other"
        text = f"{curve.label}, {curve.values[-1]:.3g}"
        yield f'<text class="{kind}" x="{RIGHT + 10}" y="{y + 4.5:.1f}">{escape(text)}</text>'
