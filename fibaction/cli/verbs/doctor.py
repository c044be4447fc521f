"""`fibaction doctor`: say what can be reached, and why nothing is found."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

import click

from fibaction.border.abc import Diagnosis
from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.options import NumberType, json_option, reject_inproc, url_of
from fibaction.cli.output.escape import clean
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.process.exit_codes import ExitCode, run

WHERE = "dds://"
"""The default URL: that of the transport whose servers are discovered."""
Fact: TypeAlias = "dict[str, Fact] | list[Fact] | str | int | float | bool"
"""A fact of a diagnosis: a value of JSON."""
_INDENT = "    "


@click.command(
    "doctor",
    epilog="""\b
Examples:
  fibaction doctor
  fibaction doctor "dds://?peers=robot.local" --action navigate_to_pose""",
)
@click.argument("where", metavar="[URL]", required=False)
@click.option(
    "-s",
    "--seconds",
    type=NumberType(),
    default=3.0,
    show_default=True,
    help="Time for which it listens.",
)
@click.option("-a", "--action", metavar="NAME", default="", help="Action that is to be found.")
@json_option
@click.pass_context
def doctor_command(
    context: click.Context, where: str | None, seconds: float, action: str, as_json: bool
) -> None:
    """Report what is found at URL, and what to do if it is not what you expect. The default is
    dds://, unless you give a URL in another way.

    At dds://, it listens for other participants; at other URLs, it tries to connect.
    """
    url = where or _given(context) or WHERE
    reject_inproc(url)
    run(diagnose, url, seconds, action, as_json=as_json)


async def diagnose(url: str, seconds: float, action: str, *, as_json: bool) -> int:
    """Print the diagnosis of a transport.

    Raises:
        ActionError: The server cannot be asked.
    """
    found = await transport_for(url).diagnose(seconds, action)
    if as_json:
        told = {"found": found.is_found, **found.facts, "advice": found.advice}
        say_json({"url": without_settings(url), **told})
    else:
        for line in lines(found):
            say(clean(line))
    return ExitCode.SUCCEEDED if found.is_found else ExitCode.UNREACHABLE


def lines(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield the lines of a diagnosis: the facts, and then the advice."""
    facts: dict[str, Fact] = diagnosis.facts
    for name, value in facts.items():
        if not isinstance(value, list):
            yield f"{_words(name)}: {_text(value)}"
            continue
        yield f"{_words(name)}: {len(value) or 'none'}"
        for one in value:
            yield f"{_INDENT}{_text(one)}"
    for sentence in diagnosis.advice:
        yield f"Advice: {sentence}"


def _text(value: Fact) -> str:
    if isinstance(value, dict):
        parts = (f"{_words(name, first=False)} {_text(one)}" for name, one in value.items())
        return ", ".join(parts)
    if isinstance(value, list):
        return " ".join(map(_text, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)


def _words(name: str, *, first: bool = True) -> str:
    words = name.replace("_", " ")
    return words[:1].upper() + words[1:] if first else words


def _given(context: click.Context) -> str:
    """Return the URL that the user has given elsewhere than to this verb; empty if none."""
    root = context.find_root()
    source = root.get_parameter_source("url")
    is_given = source is not click.core.ParameterSource.DEFAULT or root.params["address"]
    return url_of(context) if is_given else ""
