"""README for the package index: its links are absolute there, made from `[project.urls]`.

A hook of hatchling. The links of README.md are relative, so that they work in a clone and in every
branch and fork. A package index has no files beside the text, so there each link leads to the
repository at the tag of the version, and each picture to its raw file.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(?P<picture>!?)\[(?P<text>[^]]*)\]\((?P<target>[^)\s]+)\)")
_NOTES = re.compile(r"^<!--.*?-->\n+", re.DOTALL | re.MULTILINE)


def with_absolute_links(readme: str, repository: str, version: str) -> str:
    """Return the text with absolute links, and without its comments."""

    def absolute(link: re.Match[str]) -> str:
        target = link["target"]
        if "://" not in target and not target.startswith("#"):
            kind = "raw" if link["picture"] else "blob"
            target = f"{repository}/{kind}/v{version}/{target}"
        return f"{link['picture']}[{link['text']}]({target})"

    return _LINK.sub(absolute, _NOTES.sub("", readme))


class IndexReadme(MetadataHookInterface):
    """The hook that gives the package its description."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the description."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        repository = metadata["urls"]["Repository"]
        metadata["readme"] = {
            "content-type": "text/markdown",
            "text": with_absolute_links(text, repository, metadata["version"]),
        }
