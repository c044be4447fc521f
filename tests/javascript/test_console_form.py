"""The goal that a form of the console begins with is one that the server accepts."""

from __future__ import annotations

import json
import random
import subprocess
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fibaction.action_files import load_action
from fibaction.schema.payload import JsonCodec
from fibaction.schema.template import Template
from fibaction.types.schemas import schema_of
from tests.support.node import IS_LEFT_OUT, MISSING, PROGRAM
from tests.support.random_types import random_struct

ACTIONS = Path(__file__).parent.parent / "action_files"
SCHEMA_JS = Path(str(files("fibaction_transports.web"))) / "console" / "schema.js"
PATIENCE = 60.0
PROGRAM_TEXT = """
import { readFileSync } from "node:fs";
const { defaultOf, resolverOf } = await import(process.argv[1]);
const { parsed, textOf } = await import(process.argv[1].replace("schema.js", "values.js"));
const schemas = parsed(readFileSync(0, "utf8"));
const goals = schemas.map((schema) => defaultOf(schema, resolverOf(schema)));
console.log(textOf(goals, { whole: true }));
"""

pytestmark = pytest.mark.skipif(IS_LEFT_OUT, reason=MISSING)


def begins_with(schemas: list[dict[str, Any]]) -> list[Any]:
    """Return the values that forms of these schemas begin with."""
    assert PROGRAM is not None
    done = subprocess.run(
        [PROGRAM, "--input-type=module", "-e", PROGRAM_TEXT, "--", SCHEMA_JS.as_uri()],
        input=json.dumps(schemas),
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE,
    )
    goals: list[Any] = json.loads(done.stdout)
    return goals


def test_the_form_of_a_random_struct_begins_with_a_goal_of_it() -> None:
    kinds = [random_struct(random.Random(seed), 3) for seed in range(200)]
    for kind, goal in zip(kinds, begins_with([schema_of(kind) for kind in kinds]), strict=True):
        assert isinstance(msgspec.json.decode(msgspec.json.encode(goal), type=kind), kind)


def test_the_form_of_an_action_file_begins_with_a_goal_of_it() -> None:
    actions = [load_action(path, search=[ACTIONS]) for path in sorted(ACTIONS.rglob("*.action"))]
    schemas = [action.info.goal for action in actions]
    for action, schema, goal in zip(actions, schemas, begins_with(schemas), strict=True):
        assert action.goal.decode(JsonCodec(schema).encode(goal)) == action.goal.type()


@pytest.mark.parametrize(
    "schema",
    [
        {"type": "array", "items": {"type": "number"}, "minItems": 2},
        {"type": "array", "prefixItems": [{"type": "integer"}, {"const": 1}], "items": False},
        {"type": "string", "format": "date"},
        {"type": "string", "contentEncoding": "base64", "minLength": 4},
        {"type": "number", "exclusiveMinimum": 0, "maximum": 1},
        {"type": "integer", "maximum": -2},
        {"type": "integer", "exclusiveMaximum": 0},
        {"type": "integer", "multipleOf": 4, "minimum": 5},
        {"type": "integer", "multipleOf": 4, "exclusiveMinimum": 4},
        {"type": "integer", "multipleOf": 4, "maximum": -5},
        {"type": "integer", "multipleOf": 4, "exclusiveMaximum": -4},
        {"type": "integer", "multipleOf": 1.5, "minimum": 4},
        {"type": "number", "multipleOf": 0.1, "minimum": 0.25},
        {"type": "integer", "multipleOf": 0.07, "minimum": 1},
        {"type": ["boolean", "null"]},
        {"type": "object"},
        {"anyOf": [{"type": "integer", "minimum": 3}, {"type": "string"}]},
        {"properties": {"a": {"type": "null"}, "b": {"default": [1]}}},
        {"$ref": "#/$defs/A", "$defs": {"A": {"enum": ["on", "off"]}}},
    ],
)
def test_a_form_begins_with_the_template_of_the_command_line(schema: dict[str, Any]) -> None:
    assert begins_with([schema]) == [Template(schema).value]
