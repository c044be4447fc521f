"""The messages of ROS's common packages from a library, against what ROS installs."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from fibaction.interfaces import files, packages
from fibaction.interfaces.definitions import FieldType
from fibaction_transports.cdr.type_hashes import type_hash

SHARE = Path(sys.prefix, "share")


def test_each_common_message_has_the_hash_and_the_defaults_of_ros(tmp_path: Path) -> None:
    store = packages._store()
    compared = 0
    # Every package of the library that is installed here, too; `_msgs` leaves out ROS's inner ones.
    for path in sorted(SHARE.glob("*_msgs/msg/*.json")):
        theirs = json.loads(path.read_text())
        described = theirs["type_description_msg"]["type_description"]
        type_name = described["type_name"]
        if type_name not in store.fielddefs:
            continue
        package, _, name = type_name.split("/")
        text = packages.common_message(package, name)
        assert text is not None
        texts = {"a_msgs/action/Go": f"{package}/{name} it\n---\n---\n"}
        texts |= {
            one: packages.common_message(*one.split("/msg/")) or "" for one in store.fielddefs
        }
        ours = files.read_action_texts("a_msgs/action/Go", texts).goal.nested["it"]
        (expected,) = [
            one["hash_string"] for one in theirs["type_hashes"] if one["type_name"] == type_name
        ]
        assert type_hash(ours) == expected, type_name
        defaults = {
            field["name"]: float(field["default_value"])
            for field in described["fields"]
            if field["default_value"]
        }
        assert {
            field.name: field.default
            for field in ours.definition.fields
            if field.default is not None and field.type != FieldType("bool")
        } == defaults, type_name
        compared += 1
    assert compared > 50
