"""Interface files of ROS's own types: those that are installed, and those made from its classes."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import connect
from fibaction.interfaces.files import read_action_texts
from fibaction.interfaces.source import RobotSource
from fibaction.interfaces.structs import make_structs
from fibaction_transports.cdr.standard_messages import action_interface
from fibaction_transports.cdr.type_hashes import type_hash
from fibaction_transports.ros2 import DdsTransport, Ros2Transport
from fibaction_transports.ros2.convert.fields import SINGLES, array_kind, text_kind
from fibaction_transports.ros2.convert.message_types import MessageKind, interface_texts
from fibaction_transports.ros2.on_rclpy import rclpy_types
from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes
from tests.ros2.stock.ours import TYPE
from tests.ros2.stock.process import PATIENCE, peer

SHARE = Path(sys.prefix) / "share"
ACTIONS = [
    "/".join(path.with_suffix("").parts[-3:]) for path in sorted(SHARE.glob("*/action/*.action"))
]
EVERYTHING = "fibaction_test_msgs/action/Everything"


def hash_of(type_name: str, texts: dict[str, str]) -> str:
    return type_hash(action_interface(read_action_texts(type_name, texts)))


@pytest.mark.parametrize("type_name", ACTIONS)
def test_texts_made_from_the_classes_of_ros_define_the_same_type(type_name: str) -> None:
    texts = RclpyTypes().find(type_name).texts()
    described = json.loads((SHARE / f"{type_name}.json").read_text())
    hashes = {one["type_name"]: one["hash_string"] for one in described["type_hashes"]}
    assert hash_of(type_name, texts) == hashes[type_name]


@pytest.mark.parametrize("type_name", ACTIONS)
def test_texts_made_from_the_classes_of_ros_have_their_defaults_and_constants(
    type_name: str,
) -> None:
    made = make_structs(read_action_texts(type_name, RclpyTypes().find(type_name).texts()))
    whole = make_structs(read_action_texts(type_name, RclpyTypes().texts(type_name)))
    assert made.keys() == whole.keys()
    for name, struct in whole.items():
        assert msgspec.to_builtins(made[name]()) == msgspec.to_builtins(struct())
        constants = {one: value for one, value in vars(struct).items() if one.isupper()}
        assert {one: vars(made[name])[one] for one in constants} == constants


def test_installed_files_come_with_their_comments() -> None:
    text = RclpyTypes().texts(EVERYTHING)["fibaction_test_msgs/msg/Part"]
    assert text.startswith("# What Everything.action nests.")


@pytest.mark.parametrize("text", [None, "int32 other\n---\n---\n", "int33\n---\n---\n"])
def test_files_that_are_missing_or_define_another_type_are_not_taken(
    text: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rclpy_types, "ros_folders", lambda: iter([tmp_path]))
    if text is not None:
        path = tmp_path / f"{TYPE}.action"
        path.parent.mkdir(parents=True)
        path.write_text(text)
    assert RclpyTypes().texts(TYPE) == {
        TYPE: "int32 order\n---\nint32[] sequence\n---\nint32[] partial_sequence\n"
    }


class Odd(msgspec.Struct):
    """Defaults, some of which a file cannot have."""

    plain: str = "it's"
    hash_sign: str = "a # b"
    equals_sign: str = "a = b"
    many: list[str] = msgspec.field(default_factory=lambda: ["a", "b"])
    raw: bytes = b"\1\2"
    zeros: list[float] = msgspec.field(default_factory=lambda: [0.0, 0.0])
    from_: bool = True


def test_defaults_and_constants_that_a_file_cannot_have_are_left_out() -> None:
    class WithConstants(Odd):
        SMALL = -1
        LARGE = 2**63
        WORD = " spaced "
        NAMES = ("no", "constant")

    fields = {
        "plain": text_kind(wide=False, bound=None),
        "hash_sign": text_kind(wide=True, bound=9),
        "equals_sign": text_kind(wide=False, bound=None),
        "many": array_kind(text_kind(wide=False, bound=None), None, 3),
        "raw": array_kind(SINGLES["uint8"], 2, None),
        "zeros": array_kind(SINGLES["float64"], 2, None),
        "from": SINGLES["bool"],
    }
    odd = MessageKind("odd_msgs/Odd", WithConstants, fields, WithConstants)
    nothing = MessageKind(
        "odd_msgs/Go_Result", msgspec.Struct, {}, msgspec.defstruct("Nothing", [])
    )
    texts = interface_texts("odd_msgs/action/Go", odd, nothing, nothing)
    assert texts == {
        "odd_msgs/action/Go": (
            "int64 SMALL=-1\nuint64 LARGE=9223372036854775808\n"
            'string plain "it\'s"\nwstring<=9 hash_sign\nstring equals_sign\n'
            'string[<=3] many ["a", "b"]\n'
            "uint8[2] raw [1, 2]\nfloat64[2] zeros\nbool from true\n---\n---\n"
        )
    }


@pytest.mark.asyncio
async def test_a_module_written_where_ros_is_drives_the_robot_where_it_is_not(alone: str) -> None:
    """The module is written over `ros2://`, and used over `dds://` with no file at hand."""
    source = RobotSource()
    with anyio.fail_after(3 * PATIENCE):
        async with peer("tutorial_server", ROS_DOMAIN_ID=alone):
            ros = Ros2Transport(domain_id=int(alone), discovery_timeout=PATIENCE)
            async with connect(ros) as connection:
                (info,) = [one for one in await connection.actions() if one.name == "tutorial"]
                texts = await connection.interface_texts(info)
                source.add(info.name, info.type_name, texts)
            module: Any = ModuleType("robot")
            exec(compile(source.source(), "robot.py", "exec", dont_inherit=True), vars(module))
            dds = DdsTransport(domain_id=int(alone), discovery_timeout=PATIENCE)
            async with connect(dds, module.TUTORIAL) as client:
                await client.wait_for_server()
                result = await client.call(module.Fibonacci_Goal(order=4))
                assert result == module.Fibonacci_Result(sequence=[0, 1, 1, 2, 3])
