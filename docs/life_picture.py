"""docs/life.svg: the phases of a goal at its server, drawn from the table of its life.

An event that may happen in each of several phases, with the same phase after it, is one arrow from
the frame around them. Only the places, frames and bends are chosen by hand.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

from states_picture import ACTIVE, CORNER, head

from fibaction.server.life import LIFE, Event, Phase

WIDTH, HEIGHT = 1180, 590
BOX_WIDTH, BOX_HEIGHT = 156, 40

PLACES = {
    Phase.DECIDING: (96, 80),
    Phase.ACCEPTANCE_IN_WRITING: (96, 190),
    Phase.REJECTED: (96, 320),
    Phase.WAITING: (400, 190),
    Phase.BEGIN_IN_WRITING: (586, 110),
    Phase.CALLED: (876, 110),
    Phase.RUNNING_AHEAD: (586, 270),
    Phase.RUNNING: (876, 270),
    Phase.RELEASE_IN_WRITING: (430, 400),
    Phase.END_IN_WRITING: (780, 400),
    Phase.ENDED: (1090, 400),
    Phase.RELEASED: (430, 510),
    Phase.LOST: (1090, 510),
}
"""The middle of each box."""

OPEN = frozenset(
    {
        Phase.WAITING,
        Phase.BEGIN_IN_WRITING,
        Phase.CALLED,
        Phase.RUNNING_AHEAD,
        Phase.RUNNING,
    }
)
FRAMES = {
    OPEN | {Phase.END_IN_WRITING, Phase.RELEASE_IN_WRITING}: (286, 46, 976, 446),
    OPEN: (300, 60, 962, 318),
}
"""The left, upper, right and lower border of each frame, the largest frame first."""

OUTER, INNER = FRAMES
BENDS: dict[tuple[frozenset[Phase], Event], list[tuple[float, float]]] = {
    (frozenset({Phase.ACCEPTANCE_IN_WRITING}), Event.LOSE): [
        (140, 210),
        (140, 250),
        (206, 250),
        (206, 552),
        (1070, 552),
        (1070, 530),
    ],
    (frozenset({Phase.REJECTED}), Event.LOSE): [(96, 340), (96, 570), (1110, 570), (1110, 530)],
    (INNER, Event.RELEASE): [(430, 318), (430, 380)],
    (INNER, Event.END): [(780, 318), (780, 380)],
    (OUTER, Event.RELEASE_UNWRITTEN): [(600, 446), (600, 500), (508, 500)],
    (OUTER, Event.LOSE): [(900, 446), (900, 500), (1012, 500)],
}
"""The points of each arrow that is not a straight line between two boxes."""


class Arrow(NamedTuple):
    """An event that leads from each of some phases to another one."""

    sources: frozenset[Phase]
    event: Event
    target: Phase


def arrows() -> Iterator[Arrow]:
    """Find the arrows of the picture: one for a whole frame where the table has a row for each of
    its phases, else one for each phase.
    """
    sources: dict[tuple[Event, Phase], set[Phase]] = {}
    for (phase, event), step in LIFE.items():
        if step.phase is not phase:
            sources.setdefault((event, step.phase), set()).add(phase)
    for (event, target), left in sources.items():
        for frame in FRAMES:
            if frame <= left:
                left -= frame
                yield Arrow(frame, event, target)
        for phase in sorted(left):
            yield Arrow(frozenset({phase}), event, target)


def life_diagram() -> str:
    """Return the table of a goal's life as an SVG picture."""
    title = "The phases of a goal at its server, and the events between them"
    parts = [
        head(title, WIDTH, HEIGHT),
        *(_frame(*borders) for borders in FRAMES.values()),
        *(_arrow(arrow) for arrow in arrows()),
        *(_box(phase) for phase in Phase),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _arrow(arrow: Arrow) -> str:
    points = BENDS.get((arrow.sources, arrow.event)) or _line(arrow)
    (ax, ay), (bx, by) = max(pairwise(points), key=lambda ends: _length(*ends))
    path = " L".join(f"{x:g},{y:g}" for x, y in points)
    return (
        f'<path class="edge" d="M{path}"/>\n'
        f'<text class="event" x="{(ax + bx) / 2:g}" y="{(ay + by) / 2 + 4:g}">'
        f"{arrow.event.name}</text>"
    )


def _line(arrow: Arrow) -> list[tuple[float, float]]:
    """Return the ends of a straight line between two boxes, from border to border."""
    (source,) = arrow.sources
    (ax, ay), (bx, by) = PLACES[source], PLACES[arrow.target]
    dx, dy = bx - ax, by - ay
    across = abs(dx) * BOX_HEIGHT >= abs(dy) * BOX_WIDTH
    part = BOX_WIDTH / 2 / abs(dx) if across else BOX_HEIGHT / 2 / abs(dy)
    return [(ax + dx * part, ay + dy * part), (bx - dx * part, by - dy * part)]


def _length(one: tuple[float, float], other: tuple[float, float]) -> float:
    return abs(one[0] - other[0]) + abs(one[1] - other[1])


def _frame(left: float, upper: float, right: float, lower: float) -> str:
    return (
        f'<rect x="{left}" y="{upper}" width="{right - left}" height="{lower - upper}"'
        f' rx="{CORNER}" fill="none" stroke="#9aa5b1" stroke-dasharray="3 3"/>'
    )


def _box(phase: Phase) -> str:
    x, y = PLACES[phase]
    fill, line = ACTIVE if phase.is_open else ("#f1f3f5", "#37414d")
    name = phase.name.replace("_", " ")
    return (
        f'<rect x="{x - BOX_WIDTH / 2:g}" y="{y - BOX_HEIGHT / 2:g}" width="{BOX_WIDTH}"'
        f' height="{BOX_HEIGHT}" rx="{CORNER}" fill="{fill}" stroke="{line}"/>\n'
        f'<text x="{x}" y="{y + 4:g}" fill="{line}" style="font-size: 11px">{name}</text>'
    )
