"""Packages of interface files, and the places where a message may be.

A package is known by the name in its `package.xml`, and without that file by its folder.

For machines without ROS, the library rosbags has the definitions of about 160 messages of ROS's
common packages, of `std_msgs`, `geometry_msgs`, `nav_msgs`, `sensor_msgs` and others, for each
release of ROS. It leaves out the defaults of fields, which only `geometry_msgs/Quaternion` has
among them. It is imported where a message has no file.
"""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final

PACKAGE = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*", re.ASCII)
"""The name of a package."""
MOST_BYTES = 2**18
"""Bytes of a file that are read: more than any may have, see `MOST_TEXT` of the parser."""
WORKSPACE_LEVELS = 5
"""Levels of folders at which a package of a workspace is found."""
MAX_FOLDERS = 10_000
"""Folders of a workspace that are looked into."""

_MANIFEST = "package.xml"
# By its text: a parser of XML would refuse what the tools of ROS take, such as other encodings.
_MANIFEST_NAME = re.compile(r"<name[^<>]*>\s*([^<\s]+)\s*</name>")
_NO_SOURCE = ("build", "install", "log")
_IGNORE = ("COLCON_IGNORE", "AMENT_IGNORE")


def manifest_name(folder: Path) -> str:
    """Return the name in the `package.xml` of a folder; empty without such a file or name."""
    try:
        text = read_bytes(folder / _MANIFEST).decode("utf-8", "replace")
    except OSError:
        return ""
    first, *others = text.split("<!--")
    found = _MANIFEST_NAME.search(first + "".join(one.partition("-->")[2] for one in others))
    return found[1] if found and PACKAGE.fullmatch(found[1]) else ""


def read_bytes(path: Path) -> bytes:
    """Return what is in a file, and of a large one the beginning, which is too much to be parsed.

    Raises:
        OSError: It cannot be read, or is no file, such as a pipe or a device that has no end.
    """
    if not path.is_file():
        path.stat()  # tells that there is nothing
        raise OSError(errno.EINVAL, "it is not a file", str(path))
    with path.open("rb") as file:
        return file.read(MOST_BYTES)


def package_of(path: Path) -> str:
    """Return the package of an interface file; empty if its folders are not those of a package."""
    here = path.absolute().parent
    if here.name != (path.suffix[1:] if path.suffix in (".msg", ".srv") else "action"):
        return ""
    name = here.parent.name
    return manifest_name(here.parent) or (name if PACKAGE.fullmatch(name) else "")


def ros_folders() -> Iterator[Path]:
    """Yield the folders of ROS's installed interfaces.

    They are those of a sourced `setup.bash`, and those of wheels in the environment of this Python.
    """
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix, "share")
    share = Path(sys.prefix, "share")
    if (share / "ament_index").is_dir():  # else errors would name a folder without ROS
        yield share


class SearchPath:
    """The folders in which messages are searched for, in order."""

    def __init__(
        self, near: Sequence[Path], search: Sequence[Path], installed: Iterable[Path] = ()
    ) -> None:
        """`near` are folders whose own folders may be packages; `search` may be workspaces, too;
        `installed` have packages that are known by their folders.
        """
        self.roots = [*near, *search, *installed]
        self._trees = [
            *((root, 1) for root in near),
            *((root, WORKSPACE_LEVELS) for root in search),
        ]
        self._packages: dict[str, list[Path]] | None = None
        self._manifest_names: dict[Path, str] = {}
        """The names in the manifests that were looked for beside messages."""

    @classmethod
    def around(cls, path: Path, search: Sequence[Path]) -> SearchPath:
        """Return the search path of an action file: its package, those next to it, and `search`."""
        here = path.absolute().parent
        near = [here.parent.parent, here.parent, here] if package_of(path) else [here]
        return cls(near, search, ros_folders())

    def places(self, package: str, name: str) -> Iterator[Path]:
        """Yield the paths that a message may have; `package` is empty if unknown."""
        file = f"{name}.msg"
        for root in self.roots:
            own = root.absolute()
            if package:
                yield root / package / "msg" / file
            if not package or self._is_package(own, package):
                yield root / "msg" / file
            # The folder `msg` of another package may have another message of that name.
            if not package or own.name != "msg" or self._is_package(own.parent, package):
                yield root / file
        for folder in self._named(package):
            yield folder / "msg" / file
        yield from self._in_groups(package, file)

    def _in_groups(self, package: str, file: str) -> Iterator[Path]:
        """Yield the files of that name in folders within `msg`: ROS builds `msg/arm/Load.msg` as
        `package/msg/Load`, and installs the file as `package/arm/Load.msg`.
        """
        if package:
            for folder in (*(root / package for root in self.roots), *self._named(package)):
                yield from sorted(folder.glob(f"msg/*/{file}"))
                installed = (one for one in folder.glob(f"*/{file}") if one.parent.name != "msg")
                yield from sorted(installed)

    def _named(self, package: str) -> list[Path]:
        """Return the folders with a `package.xml` of that name."""
        if self._packages is None:
            self._packages = {}
            for root, levels in self._trees:
                for folder in _packages_in(root, levels):
                    self._packages.setdefault(manifest_name(folder), []).append(folder)
        return self._packages.get(package, [])

    def _is_package(self, folder: Path, package: str) -> bool:
        if folder not in self._manifest_names:
            self._manifest_names[folder] = manifest_name(folder)
        return package in (folder.name, self._manifest_names[folder])


def _packages_in(root: Path, levels: int) -> Iterator[Path]:
    """Yield the folders with a `package.xml`, as a build of the workspace would find them."""
    folders, looked = [(root, 0)], 0
    while folders and looked < MAX_FOLDERS:
        folder, level = folders.pop(0)
        looked += 1
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError:
            continue
        names = {entry.name for entry in entries}
        if not names.isdisjoint(_IGNORE):
            continue
        if _MANIFEST in names:
            yield folder
        elif level < levels:
            inside = (one for one in entries if one.name not in _NO_SOURCE and one.name[0] != ".")
            folders += [
                (Path(one), level + 1) for one in inside if one.is_dir(follow_symlinks=False)
            ]


INSTALL: Final = "pip install 'fibaction[ros-types]'"
"""The command that installs the library."""
_RELEASE: Final = "LATEST"
_ROS_2 = 2
_DEFAULTS = {
    "geometry_msgs/msg/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
}


@cache
def _store() -> Any:
    try:
        types = import_module("rosbags.typesys")
    except ImportError:
        return None
    return types.get_typestore(types.Stores[_RELEASE])


def common_message(package: str, name: str) -> str | None:
    """Return the text that defines a message; None if the library is missing, or has no such
    message.
    """
    store, type_name = _store(), f"{package}/msg/{name}"
    if store is None or type_name not in store.fielddefs:
        return None
    if type_name in _DEFAULTS:
        return _DEFAULTS[type_name]
    whole: str = store.generate_msgdef(type_name, ros_version=_ROS_2)[0]
    return whole.partition("=" * 80)[0]  # the definitions of nested messages follow


def advice(package: str) -> str:
    """Return what an error adds about a message of a package that is not found."""
    if not package or _store() is not None:
        return ""
    return f"; to get the messages of ROS's common packages: {INSTALL}"
