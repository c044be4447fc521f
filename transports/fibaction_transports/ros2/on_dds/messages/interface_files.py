"""The interface files of actions in folders, in each version that is found there."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from fibaction.interfaces import ActionFile, InterfaceError, read_action
from fibaction.interfaces.known import known_action
from fibaction.interfaces.packages import ros_folders
from fibaction.words.errors import TransportError

FOLDERS: Final = "FIBACTION_SEARCH"
"""The variable of the environment with folders of packages, separated as in PATH."""
MOST_VERSIONS: Final = 100
"""Files of one type that are read to find the version that a server has."""


class InterfaceFiles:
    """The files in some folders, in those of the environment, and in those of ROS."""

    def __init__(self, folders: Sequence[str | os.PathLike[str]]) -> None:
        """`folders` are searched first."""
        given = filter(None, os.environ.get(FOLDERS, "").split(os.pathsep))
        self._folders = [*map(Path, folders), *map(Path, given)]

    def folders(self) -> list[Path]:
        """Return the folders that are searched now."""
        return [*self._folders, *ros_folders()]

    def path(self, type_name: str) -> Path | None:
        """Return the file of a type that is found first."""
        paths = (folder / f"{type_name}.action" for folder in self.folders())
        return next((path for path in paths if path.is_file()), None)

    def first(self, type_name: str) -> ActionFile | None:
        """Return the definition of a type that this program has loaded, or that is found first.

        Raises:
            TransportError: It cannot be used.
        """
        try:
            known = known_action(type_name)
            path = self.path(type_name)
            return known if known is not None or path is None else self._read(path, type_name)
        except (InterfaceError, OSError) as exc:
            raise TransportError(f"{type_name} cannot be used: {exc}") from exc

    def versions(self, type_name: str) -> Iterator[ActionFile]:
        """Yield all definitions of a type. Their hashes tell which is that of a server.

        A file need not lie in `package/action/`: it may lie in a folder by itself, and a folder may
        have several trees of packages, such as those of several releases.
        """
        try:
            known = known_action(type_name)
        except InterfaceError:
            known = None
        if known is not None:
            yield known
        package, _, name = type_name.split("/")
        folders = self.folders()
        patterns = (f"{package}/action", "action", ".", f"*/{package}/action")
        found = (
            path
            for folder in folders
            for pattern in patterns
            for path in sorted(folder.glob(f"{pattern}/{name}.action"))
        )
        for _, path in zip(range(MOST_VERSIONS), found, strict=False):
            try:
                yield self._read(path, type_name)
            except (InterfaceError, OSError):
                continue  # it is not the first one: no one has asked for it

    def _read(self, path: Path, type_name: str) -> ActionFile:
        return read_action(path, type_name=type_name, search=self.folders())

    def advice(self, type_name: str) -> str:
        """Return what makes a type known that is not found."""
        searched = ", ".join(map(str, self.folders())) or "no folder"
        return (
            f"put {type_name}.action into a folder, and name that folder with search=FOLDER or in"
            f" {FOLDERS} (searched: {searched}), or import a module that `fibaction -u ros2:// gen"
            " --from-robot` has written where ROS has this type"
        )
