"""`fibaction service` and `param`: the services and the parameters of nodes of ROS, without ROS."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import anyio
import click

from fibaction.cli.arguments.goal_text import read_yaml
from fibaction.cli.arguments.options import full_option, json_option, url_option
from fibaction.cli.output.escape import printable
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.cli.verbs.topics import (
    all_option,
    run_at,
    say_names,
    settled,
    timeout_option,
    types_option,
)
from fibaction.types.ros_messages import plain_value
from fibaction.words.errors import ProtocolError, TransportError
from fibaction.words.plain_data import is_list


@click.group(
    "service",
    epilog='\b\nExample:\n  fibaction service call /lamp std_srvs/srv/SetBool "data: true" -u dds://',
)
def service_command() -> None:
    """List and call services of ROS, at ros2://, dds:// and zenoh:// URLs."""


@service_command.command("list")
@types_option
@all_option
@json_option
@url_option
def list_services(show_types: bool, is_all: bool, as_json: bool, url: str) -> None:
    """List the services of the graph."""

    async def act(node: Any) -> None:
        found: dict[str, str] = await settled(node, lambda view: dict(view.services()))
        own = f"{node.name}/"
        found = {name: kind for name, kind in found.items() if not name.startswith(own)}
        say_names(found, "service", is_all=is_all, show_types=show_types, as_json=as_json)

    run_at(url, act)


@service_command.command("call")
@click.argument("service")
@click.argument("type_name", metavar="TYPE")
@click.argument("request", default="")
@timeout_option
@full_option
@json_option
@url_option
def call_service(
    service: str,
    type_name: str,
    request: str,
    timeout: float,
    full: bool,
    as_json: bool,
    url: str,
) -> None:
    """Send REQUEST, which is YAML, to SERVICE once, and print the answer."""
    value = read_yaml(request, "request")

    async def act(node: Any) -> None:
        answer = plain_value(await node.call(service, type_name, value, timeout=timeout))
        if as_json:
            say_json(answer)
        else:
            say(as_yaml(answer, full=full))

    run_at(url, act)


@click.group(
    "param",
    epilog="\b\nExamples:\n  fibaction param list /planner -u dds://\n"
    "  fibaction param set /planner tolerance 0.2 -u dds://\n"
    "  fibaction param dump /planner -u dds:// > planner.yaml",
)
def param_command() -> None:
    """List, read and set parameters of nodes, at ros2://, dds:// and zenoh:// URLs."""


@param_command.command("list")
@click.argument("node_name", metavar="[NODE]", required=False)
@timeout_option
@url_option
def list_parameters(node_name: str | None, timeout: float, url: str) -> None:
    """List the parameters of NODE, or of all nodes."""

    async def act(node: Any) -> None:
        if node_name:
            return _say_parameters(await node.parameters(node_name, timeout=timeout).list())
        found: dict[str, list[str]] = {}
        silent: list[str] = []
        wrong: list[str] = []

        async def ask(one: str) -> None:
            try:
                found[one] = await node.parameters(one, timeout=timeout).list()
            except TimeoutError:
                silent.append(one)
            except (TransportError, ProtocolError) as exc:
                wrong.append(str(exc))

        async with anyio.create_task_group() as tasks:
            for one in await settled(node, _nodes) - {node.name}:
                tasks.start_soon(ask, one)
        for one, names in sorted(found.items()):
            say(printable(f"{one}:"))
            _say_parameters(names)
        wrong.sort()
        if silent:
            wrong.insert(0, f"no answer in {timeout:g} s from {', '.join(sorted(silent))}")
        if wrong:
            raise Failure("; ".join(wrong), ExitCode.UNREACHABLE)

    run_at(url, act)


def _say_parameters(names: Iterable[str]) -> None:
    for name in sorted(names):
        say(printable(f"  {name}"))


def _nodes(view: Any) -> set[str]:
    """Return the nodes that serve parameters."""
    end = "/list_parameters"
    return {name.removesuffix(end) for name, _ in view.services() if name.endswith(end)}


@param_command.command("get")
@click.argument("node_name", metavar="NODE")
@click.argument("name")
@click.option("--hide-type", is_flag=True, help="Print the value alone.")
@timeout_option
@json_option
@url_option
def get_parameter(
    node_name: str, name: str, hide_type: bool, timeout: float, as_json: bool, url: str
) -> None:
    """Print the parameter NAME of NODE."""

    async def act(node: Any) -> None:
        value = (await node.parameters(node_name, timeout=timeout).get(name))[name]
        if value is None:
            raise Failure(f"{node_name} has no parameter {name!r}")
        if as_json:
            say_json(value)
        elif hide_type:
            say(printable(str(value)))
        else:
            say(printable(f"{_words(value)}: {value}"))

    run_at(url, act)


_KINDS: Final = {
    "bool": "Boolean",
    "int": "Integer",
    "float": "Double",
    "str": "String",
    "bytes": "Byte",
}
"""The words of `ros2 param get`."""


def _words(value: Any) -> str:
    end = "values are" if is_list(value) or isinstance(value, bytes) else "value is"
    return f"{_KINDS.get(_first(value).__class__.__name__, 'Empty')} {end}"


def _first(value: Any) -> Any:
    return next(iter(value), None) if is_list(value) else value


@param_command.command("dump")
@click.argument("node_name", metavar="NODE")
@timeout_option
@url_option
def dump_parameters(node_name: str, timeout: float, url: str) -> None:
    """Print the parameters of NODE as a file for --params-file."""

    async def act(node: Any) -> None:
        values = await node.parameters(node_name, timeout=timeout).get()
        named = {name: one for name, one in sorted(values.items()) if one is not None}
        say(as_yaml({node.full_name(node_name): {"ros__parameters": named}}, full=True))

    run_at(url, act)


@param_command.command("set")
@click.argument("node_name", metavar="NODE")
@click.argument("name")
@click.argument("value")
@timeout_option
@url_option
def set_parameter(node_name: str, name: str, value: str, timeout: float, url: str) -> None:
    """Set the parameter NAME of NODE to VALUE, which is YAML."""
    read = read_yaml(value, "value") if value else ""

    async def act(node: Any) -> None:
        try:
            await node.parameters(node_name, timeout=timeout).set({name: read})
            say("Set parameter successful")
        except TypeError as exc:
            raise Failure(str(exc)) from exc

    run_at(url, act)
