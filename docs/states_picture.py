"""docs/states.svg: the statuses of a goal, drawn from the table of transitions."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fibaction.words.statuses import TRANSITIONS, GoalEvent, GoalStatus

STORED = [status for status in GoalStatus if status is not GoalStatus.UNKNOWN]
"""The statuses that a goal can have."""

# Only the places and colors are chosen by hand; boxes and arrows come from the table.

WIDTH, HEIGHT = 800, 372
BOX_WIDTH, BOX_HEIGHT, CORNER = 128, 44, 10

PLACES = {
    GoalStatus.ACCEPTED: (92, 172),
    GoalStatus.EXECUTING: (270, 54),
    GoalStatus.CANCELING: (270, 290),
    GoalStatus.SUCCEEDED: (498, 172),
    GoalStatus.ABORTED: (708, 172),
    GoalStatus.CANCELED: (708, 290),
}
"""The middles of the boxes, laid out so that no arrow crosses another."""

COLORS = {
    GoalStatus.SUCCEEDED: ("#e6f4ea", "#1e7b3a"),
    GoalStatus.ABORTED: ("#fdeaea", "#b3261e"),
    GoalStatus.CANCELED: ("#fff3e0", "#a15c00"),
}
"""Fill and line of each end; a status that continues has `ACTIVE`."""
ACTIVE = ("#e8f0fe", "#1f56b3")


def diagram() -> str:
    """Return the state machine as an SVG picture."""
    parts = [
        head("The statuses of a goal, and the events between them", WIDTH, HEIGHT),
        *(_arrow(source, event, target) for (source, event), target in TRANSITIONS.items()),
        *(_box(status) for status in STORED),
        *_legend(),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def head(title: str, width: int, height: int) -> str:
    """Return the begin of a picture: its size, its styles, and a white ground for dark pages."""
    return f"""\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}"
     height="{height}" role="img" aria-labelledby="title">
<title id="title">{title}</title>
<style>
  text {{ font: 600 13px system-ui, "Segoe UI", "DejaVu Sans", sans-serif; text-anchor: middle; }}
  .event {{ font-size: 11px; font-weight: 400; fill: #37414d; paint-order: stroke;
           stroke: #ffffff; stroke-width: 6px; stroke-linejoin: round; }}
  .note {{ font-size: 11px; font-weight: 400; fill: #5b6672; text-anchor: start; }}
  .edge {{ fill: none; stroke: #6b7682; stroke-width: 1.5; marker-end: url(#arrow); }}
  .client {{ stroke-dasharray: 6 4; }}
</style>
<defs>
  <marker id="arrow" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8"
          orient="auto"><path d="M0,1 L9,5 L0,9 z" fill="#6b7682"/></marker>
</defs>
<rect x="0.5" y="0.5" width="{width - 1}" height="{height - 1}" rx="12" fill="#ffffff"
      stroke="#d5dbe1"/>"""


def _arrow(source: GoalStatus, event: GoalEvent, target: GoalStatus) -> str:
    (ax, ay), (bx, by) = PLACES[source], PLACES[target]
    x1, y1 = _border(ax, ay, bx, by)
    x2, y2 = _border(bx, by, ax, ay)
    x, y = (x1 + x2) / 2, (y1 + y2) / 2 + 4
    kind = "edge client" if event is GoalEvent.CANCEL_GOAL else "edge"
    return (
        f'<path class="{kind}" d="M{x1:.1f},{y1:.1f} L{x2:.1f},{y2:.1f}"/>\n'
        f'<text class="event" x="{x:.1f}" y="{y:.1f}">{event.name}</text>'
    )


def _border(x: float, y: float, to_x: float, to_y: float) -> tuple[float, float]:
    """Return the point, with a small gap, where a line from the middle of a box leaves it."""
    dx, dy = to_x - x, to_y - y
    scale = min(
        BOX_WIDTH / 2 / abs(dx) if dx else math.inf,
        BOX_HEIGHT / 2 / abs(dy) if dy else math.inf,
    )
    scale += 4 / math.hypot(dx, dy)
    return x + dx * scale, y + dy * scale


def _box(status: GoalStatus) -> str:
    x, y = PLACES[status]
    fill, line = COLORS.get(status, ACTIVE)
    width = 3 if status.is_terminal else 1.5
    return (
        f'<rect x="{x - BOX_WIDTH / 2:g}" y="{y - BOX_HEIGHT / 2:g}" width="{BOX_WIDTH}"'
        f' height="{BOX_HEIGHT}" rx="{CORNER}" fill="{fill}" stroke="{line}"'
        f' stroke-width="{width:g}"/>\n'
        f'<text x="{x}" y="{y + 4.5:g}" fill="{line}">{status.name} {status.value}</text>'
    )


def _legend() -> Iterator[str]:
    y = HEIGHT - 22
    for x, kind, words in (
        (28, "edge client", "asked for by a client"),
        (216, "edge", "done by the server"),
    ):
        yield f'<path class="{kind}" d="M{x},{y} h32"/>'
        yield f'<text class="note" x="{x + 42}" y="{y + 4}">{words}</text>'
    yield f'<text class="note" x="390" y="{y + 4}">thick border: the goal has ended</text>'
