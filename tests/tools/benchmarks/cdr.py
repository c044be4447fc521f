"""The time of a message between its struct and bytes of CDR, beside the library rosbags.

    python -m tests.tools.benchmarks.cdr

It prints the microseconds to encode and to decode, for messages of several sizes: the best of many
turns, so that a busy machine counts little. rosbags is measured if it is installed, with the
structs of its own, in which arrays are those of numpy.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from time import perf_counter
from typing import Any

from tests.transports.cdr.definitions import POSES, Goal

TURNS = 40
SECONDS = 0.01
"""The least time of a turn."""

MESSAGES = POSES | {
    "made_msgs/Feedback": "int32[] sequence",
    "made_msgs/Image": "uint8[] data",
    "made_msgs/Grid": "int8[] data",
    "made_msgs/Points": "geometry_msgs/Point[] points",
    "made_msgs/Path": "geometry_msgs/PoseStamped[] poses",
    "made_msgs/Field": "string name\nuint32 offset\nuint8 datatype\nuint32 count",
    "made_msgs/Cloud": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense"
    ),
}
MEGABYTE = 1_000_000


def best(call: Callable[[], Any]) -> float:
    """Return the microseconds of a call."""
    times = 1
    while _elapsed(call, times) < SECONDS:
        times *= 2
    return min(_elapsed(call, times) for _ in range(TURNS)) / times * 1e6


def _elapsed(call: Callable[[], Any], times: int) -> float:
    begin = perf_counter()
    for _ in range(times):
        call()
    return perf_counter() - begin


def ours(text: str, fill: Callable[[Any], Any], *, as_arrays: bool = False) -> tuple[float, float]:
    """Return the times of the codec."""
    goal = Goal(text, MESSAGES, as_arrays=as_arrays)
    value = goal.type(**fill(goal.structs))
    payload = goal.codec.encode(value)
    return best(lambda: goal.codec.encode(value)), best(lambda: goal.codec.decode(payload))


def of_rosbags(text: str, fill: Callable[[Any], Any]) -> tuple[float, float]:
    """Return the times of rosbags."""
    typesys = import_module("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    time = {"builtin_interfaces/Time": "int32 sec\nuint32 nanosec"}
    texts = time | MESSAGES | {"made_msgs/Made_Goal": text}
    for name, definition in texts.items():
        full = name.replace("/", "/msg/")
        store.register(typesys.get_types_from_msg(definition, full))

    class Structs(dict[str, Any]):
        def __missing__(self, name: str) -> Any:
            return next(cls for full, cls in store.types.items() if full.endswith(f"/{name}"))

    value = Structs()["Made_Goal"](**fill(Structs()))
    payload = store.serialize_cdr(value, "made_msgs/msg/Made_Goal")
    return (
        best(lambda: store.serialize_cdr(value, "made_msgs/msg/Made_Goal")),
        best(lambda: store.deserialize_cdr(payload, "made_msgs/msg/Made_Goal")),
    )


def pose(structs: Any) -> Any:
    return structs["PoseStamped"](
        header=header(structs),
        pose=structs["Pose"](
            position=point(structs), orientation=structs["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        ),
    )


def header(structs: Any) -> Any:
    return structs["Header"](stamp=structs["Time"](sec=1, nanosec=2), frame_id="map")


def point(structs: Any) -> Any:
    return structs["Point"](x=1.5, y=2.5, z=3.5)


def cloud(structs: Any, data: Any) -> dict[str, Any]:
    """Return the fields of a point cloud."""
    fields = [
        structs["Field"](name=name, offset=4 * index, datatype=7, count=1)
        for index, name in enumerate(["x", "y", "z", "intensity"])
    ]
    width = MEGABYTE // 16
    return {
        "header": header(structs),
        "height": 1,
        "width": width,
        "fields": fields,
        "is_bigendian": False,
        "point_step": 16,
        "row_step": 16 * width,
        "data": data,
        "is_dense": True,
    }


def main() -> None:
    """Measure, and print a line for each message."""
    numbers = list(range(10))
    cells = array("b", bytes(MEGABYTE))
    cases: list[tuple[str, str, Callable[[Any], Any], Callable[[Any], Any], bool]] = [
        (
            "10 numbers",
            MESSAGES["made_msgs/Feedback"],
            lambda structs: {"sequence": numbers},
            lambda structs: {"sequence": numpy().array(numbers, "int32")},
            False,
        ),
        (
            "PoseStamped",
            "geometry_msgs/PoseStamped pose",
            lambda structs: {"pose": pose(structs)},
            lambda structs: {"pose": pose(structs)},
            False,
        ),
        (
            "1,000 Points",
            "geometry_msgs/Point[] points",
            lambda structs: {"points": [point(structs)] * 1000},
            lambda structs: {"points": [point(structs)] * 1000},
            False,
        ),
        (
            "1 MB of uint8",
            "uint8[] data",
            lambda structs: {"data": bytes(MEGABYTE)},
            lambda structs: {"data": numpy().zeros(MEGABYTE, "uint8")},
            False,
        ),
        (
            "cloud of 1 MB",
            MESSAGES["made_msgs/Cloud"],
            lambda structs: cloud(structs, bytes(MEGABYTE)),
            lambda structs: cloud(structs, numpy().zeros(MEGABYTE, "uint8")),
            False,
        ),
        (
            "grid of 1 MB, as array",
            "int8[] data",
            lambda structs: {"data": cells},
            lambda structs: {"data": numpy().zeros(MEGABYTE, "int8")},
            True,
        ),
        (
            "grid of 1 MB, as list",
            "int8[] data",
            lambda structs: {"data": cells.tolist()},
            lambda structs: {"data": numpy().zeros(MEGABYTE, "int8")},
            False,
        ),
    ]
    print(f"{'microseconds':24}{'encode':>10}{'decode':>10}   rosbags: encode, decode")
    for name, text, fill, fill_rosbags, as_arrays in cases:
        here = ours(text, fill, as_arrays=as_arrays)
        line = f"{name:24}{here[0]:10.1f}{here[1]:10.1f}"
        if find_spec("rosbags") is not None:
            there = of_rosbags(text, fill_rosbags)
            line += f"{there[0]:20.1f}{there[1]:10.1f}"
        print(line)


def numpy() -> Any:
    """Return numpy, which rosbags needs."""
    return import_module("numpy")


if __name__ == "__main__":
    main()
