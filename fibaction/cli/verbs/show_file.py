"""`fibaction show`: a summary of a recording."""

from __future__ import annotations

from collections import Counter
from datetime import datetime
from typing import Any

import click

from fibaction.cli.arguments.action_names import shown
from fibaction.cli.output.escape import clean
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure

SECOND = 1_000_000_000


class Summary:
    """The numbers of one action in a recording."""

    def __init__(self) -> None:
        self.active: set[str] = set()
        self.ends: Counter[str] = Counter()
        self.feedback = 0

    @property
    def goals(self) -> int:
        """The number of its goals."""
        return self.ends.total() + len(self.active)

    def __str__(self) -> str:
        ends = [f"{count} {status}" for status, count in self.ends.most_common()]
        if self.active:
            ends.append(f"{len(self.active)} without an end")
        messages = "feedback message" if self.feedback == 1 else "feedback messages"
        return f"{', '.join(ends) or 'no goals'}; {self.feedback:,} {messages}"

    def json(self) -> dict[str, Any]:
        """Return the numbers as JSON data."""
        return {"ends": self.ends, "active": len(self.active), "feedback": self.feedback}


@click.command("show", epilog="\b\nExample:\n  fibaction show today.jsonl")
@click.argument("file", metavar="FILE", type=click.Path(exists=True, dir_okay=False))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def show_command(file: str, as_json: bool) -> None:
    """Summarise a recording of `fibaction serve --record`."""
    from fibaction.observe.recordings.recording_file import read_records

    first = last = dropped = 0
    actions: dict[str, Summary] = {}
    for record in read_records(file):
        first, last = first or record.time, record.time
        if record.event == "dropped":
            dropped += record.number
            continue
        found = actions.setdefault(record.action, Summary())
        if record.event == "feedback":
            found.feedback += 1
        elif record.event == "accepted":
            found.active.add(record.goal_id)
        elif record.event in ("end", "rejected"):
            found.active.discard(record.goal_id)
            found.ends[record.status or "REJECTED"] += 1
    if not actions:
        raise Failure(f"{file} is not a recording of fibaction, or is empty", ExitCode.USAGE)
    if as_json:
        summaries = {name: found.json() for name, found in actions.items()}
        say_json({"first": first, "last": last, "dropped": dropped, "actions": summaries})
        return
    begin, end = (datetime.fromtimestamp(time // SECOND) for time in (first, last))
    same_day = begin.date() == end.date()
    until = end.strftime("%H:%M:%S") if same_day else str(end)
    goals = sum(found.goals for found in actions.values())
    say(f"{begin} to {until}, {goals} {'goal' if goals == 1 else 'goals'}")
    for name, found in actions.items():
        say(f"{clean(shown(name))}: {clean(str(found))}")
    if dropped:
        say(f"feedback messages that are missing: {dropped:,}")
