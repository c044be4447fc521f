"""Build the documentation into site/, or say what is wrong with it.

    python docs/build.py

First what is made from the code is made again: docs/states.svg, and the marked parts of
docs/concepts.md and docs/protocol.md. Then the site is built strictly, and its pages are read once
more: a link or an anchor that leads nowhere, or something that is fetched from elsewhere, ends with
exit code 1.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import inspect
import math
import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, get_args
from urllib.parse import unquote, urlsplit

import msgspec
from msgspec import inspect as types

from fibaction import messages
from fibaction.action import ActionInfo
from fibaction.exceptions import ActionError
from fibaction.states import TRANSITIONS, GoalEvent, GoalStatus
from fibaction.wire.limits import Limits

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
SITE = ROOT / "site"

STORED = [status for status in GoalStatus if status is not GoalStatus.UNKNOWN]
"""The statuses that a goal can have."""

# The drawing. Only the places and colors are chosen by hand; boxes and arrows come from the table.

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
"""Fill and line of each end; a status that goes on has `ACTIVE`."""
ACTIVE = ("#e8f0fe", "#1f56b3")

HEAD = f"""\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}"
     height="{HEIGHT}" role="img" aria-labelledby="title">
<title id="title">The statuses of a goal, and the events between them</title>
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
<rect x="0.5" y="0.5" width="{WIDTH - 1}" height="{HEIGHT - 1}" rx="12" fill="#ffffff"
      stroke="#d5dbe1"/>"""
# White below: the picture is shown on dark pages, too.


def diagram() -> str:
    """The state machine as an SVG picture."""
    parts = [
        HEAD,
        *(_arrow(source, event, target) for (source, event), target in TRANSITIONS.items()),
        *(_box(status) for status in STORED),
        *_legend(),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


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
    """Where a line from the middle of a box leaves it, and a little further."""
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


# The marked parts of concepts.md


def states_part() -> str:
    """The picture, and for each status what each event leads to."""
    picture = "The statuses of a goal and the events between them; the table says the same"
    columns = ["Status", *(event.name for event in GoalEvent)]
    lines = [f"![{picture}](states.svg)", "", _row(columns), _row(["---"] * len(columns))]
    for status in STORED:
        following = (TRANSITIONS.get((status, event)) for event in GoalEvent)
        cells = ("" if after is None else after.name for after in following)
        lines.append(_row([f"{status.name}&nbsp;{status.value}", *cells]))
    return "\n".join(lines)


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def errors_part() -> str:
    """Every error, each with the first sentence of its docstring, as a tree."""
    lines = list(_errors(ActionError, ""))
    width = max(len(name) for name, _ in lines)
    return "\n".join(("```text", *(f"{name:{width}}  {text}" for name, text in lines), "```"))


def _errors(error: type[ActionError], indent: str) -> Iterator[tuple[str, str]]:
    if not error.__name__.startswith("_"):
        text = re.split(r"[:;.](?:\s|$)", error.__doc__ or "", maxsplit=1)[0]
        yield indent + error.__name__, text
        indent += "  "
    for child in error.__subclasses__():
        if child.__module__ == ActionError.__module__:
            yield from _errors(child, indent)


# The marked parts of protocol.md

MEANINGS = {
    "id": "The request that this is, or belongs to.",
    "action": "The action's name.",
    "goal_id": "The goal's ID.",
    "goal": "The goal itself: a payload.",
    "credit": "How many `GoalChanged` may come before more credit.",
    "stamp": "When the goal was accepted: nanoseconds since 1970, by the server's clock.",
    "status": "A [goal status](#statuses).",
    "reason": "Why, for a person to read; may be empty.",
    "text": "A sentence, for a person to read.",
    "version": "Of the protocol: 1.",
    "heartbeat": "Seconds: at least so often this side will send something.",
    "count": "How much more credit there is.",
    "number": "The feedback's place among all feedback of the goal: 1, 2, 3 and so on.",
    "payload": "The feedback itself.",
    "result": "The result, a payload; nil if there is none.",
    "return_code": "A [return code](#return-codes).",
    "goals": "The goals whose cancel was accepted: ID, stamp, status.",
    "actions": "Each action that is served here.",
    "name": "The action's name.",
    "type_name": "Its ROS 2 type, or empty.",
    "feedback": "The JSON Schema of a feedback message.",
    "latest": "Whether a reader who is late wants the newest feedback only: the server's policy.",
    "after": "Begin behind the feedback of that number; nil: with what comes from now on.",
    "CancelGoals.goal_id": "The goal it is about; nil or zeros: see below.",
    "CancelGoals.stamp": "Goals accepted at or before it; nil or 0: see below.",
    "Ended.status": "4, 5 or 6: a [goal status](#statuses); 0: the server does not know.",
    "Ended.place": "The number of the feedback that was sent last, or skipped.",
    "GoalChanged.stamp": "When it was accepted; 0 if `status` is 0.",
    "GoalChanged.status": "A [goal status](#statuses); 0: the server has forgotten the goal.",
    "ActionInfo.goal": "The JSON Schema of a goal.",
    "ActionInfo.result": "The JSON Schema of a result.",
}
"""What a field is, by its name; its own docstring counts unless the message is named here, too."""


def messages_part() -> str:
    """Every message: its form, its fields, and the bytes of one."""
    client, server = get_args(messages.FromClient), get_args(messages.FromServer)
    groups = {
        "From either side": [kind for kind in client if kind in server],
        "From the client": [kind for kind in client if kind not in server],
        "From the server": [kind for kind in server if kind not in client],
    }
    bytes_of = golden_bytes()
    return "\n\n".join(
        f"### {title}\n\n" + "\n\n".join(_message(kind, bytes_of[kind]) for kind in kinds)
        for title, kinds in groups.items()
    )


def golden_bytes() -> dict[type, str]:
    """For each message type the bytes of one message, in hexadecimal: what the tests check."""
    spec = importlib.util.spec_from_file_location("golden", ROOT / "tests" / "golden.py")
    assert spec is not None
    assert spec.loader is not None
    golden = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(golden)
    return {type(message): digits for message, digits in golden.GOLDEN}


def _message(kind: type[msgspec.Struct], digits: str) -> str:
    tag = kind.__struct_config__.tag
    form = ", ".join((str(tag), *kind.__struct_fields__))
    example = _shown(msgspec.msgpack.decode(bytes.fromhex(digits)))
    parts = [f"#### {kind.__name__}", f"`[{form}]`", _prose(kind.__doc__)]
    if kind.__struct_fields__:
        parts.append(_fields(kind))
    parts.append(f"```text\n{example}\n{digits}\n```")
    return "\n\n".join(parts)


def _fields(kind: type[msgspec.Struct]) -> str:
    described = types.type_info(kind)
    assert isinstance(described, types.StructType)
    docs = _docs_of_fields(kind)
    lines = [_row(["Field", "Type", "Default", "Meaning"]), _row(["---"] * 4)]
    for field in described.fields:
        default = "" if field.required else f"`{_shown(_default(field))}`"
        meaning = (
            MEANINGS.get(f"{kind.__name__}.{field.name}")
            or docs[field.name]
            or MEANINGS[field.name]
        )
        lines.append(_row([f"`{field.name}`", _wire(field.type), default, meaning]))
    return "\n".join(lines)


def _default(field: types.Field) -> object:
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()


def _docs_of_fields(kind: type) -> dict[str, str]:
    """What stands below each field in the source; nothing for a field that says it all."""
    (described,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(described, ast.ClassDef)
    docs: dict[str, str] = {}
    field = ""
    for node in described.body:
        match node:
            case ast.AnnAssign(target=ast.Name(id=field)):
                docs[field] = ""
            case ast.Expr(value=ast.Constant(value=str(text))) if field:
                docs[field] = _prose(text)
            case _:
                field = ""
    return docs


def _prose(text: str | None) -> str:
    return " ".join((text or "").split())


def _wire(described: types.Type) -> str:
    """A type, as the peer sees it."""
    match described:
        case types.NoneType():
            return "nil"
        case types.BoolType():
            return "boolean"
        case types.StrType():
            return "text"
        case types.BytesType(min_length=None):
            return "bytes"
        case types.BytesType(min_length=length):
            return f"{length} bytes"
        case types.IntType():
            return "integer" + _range(described)
        case types.FloatType():
            return "number" + _range(described)
        case types.UnionType():
            return " or ".join(map(_wire, described.types))
        case types.ListType():
            return f"array of {_wire(described.item_type)}"
        case types.TupleType():
            return f"({'; '.join(map(_wire, described.item_types))})"
        case types.StructType(cls=cls) if cls is ActionInfo:
            return "[action descriptions](#descriptions-of-actions)"
        case types.DictType():
            return "map"
    raise TypeError(f"no message had a {described} before: say how it looks on the wire")


def _range(described: types.IntType | types.FloatType) -> str:
    least, most = described.ge, described.le
    if described.lt is not None:
        most = described.lt - 1
    if described.gt is not None:
        return f", more than {described.gt:g}, at most {most:g}"
    if least is None:
        return ""
    power = {2**31 - 1: "2^31-1", 2**63 - 1: "2^63-1"}
    return f", {least} to {power.get(int(most or 0), most)}"


def _shown(value: Any) -> str:
    """A decoded value, in the notation of RFC 8949: byte strings are like h'00ff'."""
    if isinstance(value, bytes):
        return f"h'{value.hex()}'"
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_shown(key)}: {_shown(one)}' for key, one in value.items())}}}"
    return msgspec.json.encode(value).decode()


def descriptions_part() -> str:
    """The keys of the description of an action."""
    return _fields(ActionInfo).replace("Field", "Key", 1)


def limits_part() -> str:
    """What a server of fibaction lets a client use, if nothing else is said."""
    return _fields(Limits).replace("Field", "Limit", 1)


PARTS: dict[str, dict[str, Callable[[], str]]] = {
    "concepts.md": {"states": states_part, "errors": errors_part},
    "protocol.md": {
        "messages": messages_part,
        "descriptions": descriptions_part,
        "limits": limits_part,
    },
}
"""What is made for each pair of markers in a page."""


def with_parts(page: str, parts: dict[str, Callable[[], str]]) -> str:
    """The page, with what stands between its markers made anew.

    Raises:
        ValueError: A pair of markers is missing.
    """
    for name, make in parts.items():
        start, end = f"<!-- {name}: made by docs/build.py -->", f"<!-- end of {name} -->"
        before, found, rest = page.partition(start)
        _, closed, after = rest.partition(end)
        if not (found and closed):
            raise ValueError(f"the page has no part for {name!r}")
        page = f"{before}{start}\n\n{make()}\n\n{end}{after}"
    return page


def generate() -> None:
    """Write docs/states.svg, and the marked parts of the pages."""
    (DOCS / "states.svg").write_text(diagram(), encoding="utf-8")
    for name, parts in PARTS.items():
        path = DOCS / name
        path.write_text(with_parts(path.read_text(encoding="utf-8"), parts), encoding="utf-8")


# The check of the built pages


class _Page(HTMLParser):
    """The places of a page that can be linked to, and what the page itself links to or loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[tuple[int, str, str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if value is None:
                continue
            if name == "id" or (tag == "a" and name == "name"):
                self.anchors.add(value)
            elif name in ("href", "src"):
                self.links.append((self.getpos()[0], tag, value))


def problems(site: Path) -> list[str]:
    """What is wrong with the links of the HTML pages of a site, a line for each."""
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    return [
        f"{path.relative_to(site)}:{line}: {link!r} {wrong}"
        for path, page in pages.items()
        for line, tag, link in page.links
        if (wrong := _wrong(site, pages, path, tag, link))
    ]


def _wrong(site: Path, pages: dict[Path, _Page], path: Path, tag: str, link: str) -> str:
    url = urlsplit(link)
    if url.scheme or url.netloc:
        loaded = tag != "a" and url.scheme != "data"
        return "is loaded from elsewhere" if loaded else ""
    target = path
    if url.path:
        base = site if url.path.startswith("/") else path.parent
        target = Path(os.path.normpath(base / unquote(url.path).lstrip("/")))
        if target.is_dir():
            target /= "index.html"
    if not target.is_file():
        return "leads to no file"
    anchor = unquote(url.fragment)
    if anchor and target in pages and anchor not in pages[target].anchors:
        return f"leads to no place in {target.relative_to(site)}"
    return ""


_COLORING = re.compile(r"\x1b\[[0-9;]*m")


def build() -> str:
    """Build the site; what is wrong with it, or nothing."""
    generate()
    shutil.rmtree(SITE, ignore_errors=True)
    built = subprocess.run(
        [sys.executable, "-m", "zensical", "build", "--clean", "--strict"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if built.returncode == 0:
        return "\n".join(problems(SITE))
    output = _COLORING.sub("", built.stdout + built.stderr)
    if "Aborted because --strict" in output:
        # The warnings say it all; the traceback is that of the tool.
        output = output.partition("Traceback (most recent call last)")[0]
    elif unknown := re.search(r"Could not collect '(.+)'", output):
        output = "".join(f"{place}: there is no {unknown[1]}\n" for place in _asking(unknown[1]))
    return output


def _asking(name: str) -> Iterator[str]:
    for path in sorted(DOCS.rglob("*.md")):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if line == f"::: {name}":
                yield f"{path.relative_to(ROOT)}:{number}"


if __name__ == "__main__":
    argparse.ArgumentParser(
        prog="python docs/build.py",
        description="Build the documentation into site/, or say what is wrong with it.",
    ).parse_args()
    sys.exit(build() or None)
