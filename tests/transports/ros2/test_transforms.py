"""The frames of a robot, compared with matrices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction_transports.ros2.messaging import transforms
from fibaction_transports.ros2.messaging.transforms import Transform, TransformBuffer, unit

SECOND = 10**9

lengths = st.floats(-100, 100)
parts = st.floats(-1, 1)


@st.composite
def poses(draw: st.DrawFn) -> Transform:
    pose = unit(Transform(*(draw(lengths) for _ in range(3)), *(draw(parts) for _ in range(4))))
    return pose or Transform()


def matrix(pose: Transform) -> Any:
    """Return a pose as a matrix of 4 by 4, by the formula of textbooks."""
    x, y, z, w = pose[3:]
    whole = np.eye(4)
    whole[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    whole[:3, 3] = pose[:3]
    return whole


def same(pose: Transform, wanted: Any) -> bool:
    return bool(np.allclose(matrix(pose), wanted, atol=1e-6))


@given(st.lists(poses(), min_size=4, max_size=4), st.tuples(lengths, lengths, lengths))
def test_frames_that_branch_are_as_the_product_of_their_matrices(
    links: list[Transform], point: tuple[float, float, float]
) -> None:
    buffer = TransformBuffer()
    buffer.add("base", "odom", SECOND, links[0])
    buffer.add("odom", "map", SECOND, links[1], is_static=True)
    buffer.add("/tag", "map", SECOND, links[2])
    buffer.add("grip", "base/", SECOND, links[3])
    base, odom, tag, grip = map(matrix, links)
    whole = np.linalg.inv(tag) @ odom @ base @ grip
    found = buffer.look_up("grip", "tag")
    assert same(found, whole)
    assert same(buffer.look_up("tag", "grip"), np.linalg.inv(whole))
    assert same(found.after(found.inverse()), np.eye(4))
    assert np.allclose(found.apply(*point), (whole @ [*point, 1])[:3], atol=1e-6)
    assert same(buffer.look_up("map", "map"), np.eye(4))


@given(poses(), poses(), st.floats(0, 1))
def test_between_two_times_a_pose_moves_evenly_along_the_shorter_arc(
    first: Transform, last: Transform, share: float
) -> None:
    buffer = TransformBuffer()
    buffer.add("base", "odom", 2 * SECOND, last)
    buffer.add("base", "odom", SECOND, first)
    found = buffer.look_up("base", "odom", SECOND + round(share * SECOND))
    place = [a + share * (b - a) for a, b in zip(first[:3], last[:3], strict=True)]
    assert np.allclose(found[:3], place, atol=1e-5)
    assert math.isclose(math.hypot(*found[3:]), 1, abs_tol=1e-9)

    def angle(one: Transform, other: Transform) -> float:
        cosine = abs(sum(a * b for a, b in zip(one[3:], other[3:], strict=True)))
        return 2 * math.acos(min(cosine, 1.0))

    whole = angle(first, last)
    assert whole <= math.pi + 1e-6
    # An arc of half a turn has no shorter side; a cosine near 1 tells small angles badly.
    assert math.isclose(angle(first, found), share * whole, abs_tol=2e-4)


def test_without_a_time_the_newest_counts_that_is_known_of_all_frames() -> None:
    buffer = TransformBuffer()
    for second in (1, 2, 3):
        buffer.add("base", "odom", second * SECOND, Transform(x=float(second)))
    buffer.add("odom", "map", 2 * SECOND, Transform(y=1.0))
    assert buffer.look_up("base", "map") == Transform(x=2.0, y=1.0)
    assert buffer.look_up("base", "odom") == Transform(x=3.0)
    buffer.add("base", "odom", 3 * SECOND, Transform(x=4.0))
    assert buffer.look_up("base", "odom") == Transform(x=4.0)
    buffer.add("base", "cart", SECOND, Transform(x=9.0))
    assert buffer.look_up("base", "cart") == Transform(x=9.0)
    with pytest.raises(LookupError, match="'base' and 'map' are not connected"):
        buffer.look_up("base", "map")


def test_what_is_not_known_is_told() -> None:
    buffer = TransformBuffer()
    with pytest.raises(LookupError, match="nothing is known of 'base' and 'map'"):
        buffer.look_up("base", "map")
    buffer.add("base", "odom", SECOND, Transform())
    buffer.add("tag", "map", SECOND, Transform())
    with pytest.raises(LookupError, match="'base' and 'map' are not connected"):
        buffer.look_up("base", "map")
    for time in (0, 2 * SECOND):
        with pytest.raises(LookupError, match=r"'base' is known from 1.000 s to 1.000 s, and not"):
            buffer.look_up("base", "odom", time)


def test_the_past_and_the_number_of_frames_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transforms, "MOST_FRAMES", 3)
    monkeypatch.setattr(transforms, "MOST_TIMES", 5)
    buffer = TransformBuffer()
    for second in range(8):
        buffer.add("base", "odom", second * SECOND // 10, Transform(x=float(second)))
    with pytest.raises(LookupError, match=r"from 0.300 s to 0.700 s"):
        buffer.look_up("base", "odom", 0)
    buffer.add("base", "odom", 60 * SECOND, Transform())
    with pytest.raises(LookupError, match=r"from 60.000 s to 60.000 s"):
        buffer.look_up("base", "odom", 0)
    for number in range(5):
        buffer.add(f"frame{number}", "odom", 0, Transform())
    with pytest.raises(LookupError, match="nothing is known of 'frame4'"):
        buffer.look_up("frame4", "odom")


def test_what_is_no_pose_is_left_out_and_a_circle_of_frames_ends() -> None:
    buffer = TransformBuffer()
    for wrong in (Transform(x=math.nan), Transform(qw=0.0), Transform(qz=math.inf)):
        buffer.add("base", "odom", SECOND, wrong)
    buffer.add("base", "base", SECOND, Transform())
    buffer.add("", "base", SECOND, Transform())
    with pytest.raises(LookupError, match="nothing is known"):
        buffer.look_up("base", "odom")
    buffer.add("a", "b", SECOND, Transform(x=1.0))
    buffer.add("b", "a", SECOND, Transform(x=1.0))
    with pytest.raises(LookupError, match="nothing is known of 'c'"):
        buffer.look_up("a", "c")
    assert math.isclose(Transform(qz=math.sin(0.25), qw=math.cos(0.25)).yaw, 0.5)
