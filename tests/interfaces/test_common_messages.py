"""The messages of ROS's common packages, from a library where ROS is not installed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fibaction.interfaces import packages
from fibaction.interfaces.definitions import InterfaceError
from fibaction.interfaces.files import read_action
from fibaction.interfaces.packages import common_message
from fibaction.interfaces.structs import make_structs
from fibaction_transports.cdr.type_hashes import type_hash
from tests.support.interface_files import write

pytestmark = pytest.mark.usefixtures("no_ros")


def test_a_common_message_is_that_of_ros(tmp_path: Path) -> None:
    path = write(tmp_path / "go_msgs/action/Go.action", "geometry_msgs/PoseStamped it\n---\n---\n")
    found = read_action(path).goal.nested["it"]
    assert found.type_name == "geometry_msgs/msg/PoseStamped"
    # The hash that ROS 2 Kilted has in `share/geometry_msgs/msg/PoseStamped.json`.
    known = "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
    assert type_hash(found) == known


def test_a_common_message_has_its_defaults_and_constants(tmp_path: Path) -> None:
    goal = "geometry_msgs/Pose to\nsensor_msgs/NavSatStatus fix\n"
    path = write(tmp_path / "Go.action", f"{goal}---\n---\n")
    structs = make_structs(read_action(path))
    assert structs["Go_Goal"]().to.orientation.w == 1.0  # type: ignore[attr-defined]
    assert structs["NavSatStatus"].STATUS_FIX == 0  # type: ignore[attr-defined]


def test_without_the_library_there_are_none_and_an_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "Go.action"
    for package, ending in (
        (
            "geometry_msgs/",
            "; to get the messages of ROS's common packages: pip install 'fibaction[ros-types]'",
        ),
        ("", str(tmp_path)),
    ):
        path.write_text(f"{package}Thing it\n---\n---\n")
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, "rosbags.typesys", None)
            assert common_message("geometry_msgs", "Pose") is None
            with pytest.raises(InterfaceError) as caught:
                read_action(path)
        assert str(caught.value).endswith(ending)
    packages._store.cache_clear()
    path.write_text("geometry_msgs/Thing it\n---\n---\n")
    with pytest.raises(InterfaceError, match=r"in .*test_without_the_library\S*$"):
        read_action(path)
