"""`Images`: images in the feedback and the results of goals, which a model sees as images.

An image is bytes whose schema has an image in `contentMediaType`, or which begin as a file of one
of the common formats does. In the data it is replaced by its name, since a model can do nothing
with base64 text.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

from mcp_types import ImageContent

from fibaction.border.plain_values import is_list, is_map

MOST_IMAGES = 4
"""Images of one answer."""
LARGEST_IMAGE = 5 * 2**20
"""Bytes of an image; models take no larger ones."""
DEEPEST = 32
"""Levels of a message in which images are looked for."""

_PREFIX = "#/$defs/"
_BEGINNINGS = {
    b"\x89PNG\r\n\x1a\n": "image/png",
    b"\xff\xd8\xff": "image/jpeg",
    b"GIF87a": "image/gif",
    b"GIF89a": "image/gif",
}


class Images:
    """The images of one answer."""

    def __init__(self) -> None:
        self.found: list[ImageContent] = []
        """The images, in the order of their numbers."""

    def take(self, message: Any, schema: Mapping[str, Any]) -> Any:
        """Return a message of that schema with the names of its images in place of them."""
        return self._take(message, schema, schema.get("$defs", {}), DEEPEST)

    def _take(self, value: Any, part: Any, definitions: Mapping[str, Any], levels: int) -> Any:
        if is_map(part) and isinstance(part.get("$ref"), str):
            part = definitions.get(part["$ref"].removeprefix(_PREFIX))
        known: Mapping[Any, Any] = part if is_map(part) else {}
        if isinstance(value, bytes):
            return self._named(value, known.get("contentMediaType"))
        if levels == 0:
            return value
        if is_map(value):
            fields = known.get("properties", {})
            return {
                name: self._take(one, fields.get(name), definitions, levels - 1)
                for name, one in value.items()
            }
        if is_list(value):
            items = known.get("items")
            return [self._take(one, items, definitions, levels - 1) for one in value]
        return value

    def _named(self, value: bytes, declared: Any) -> Any:
        """Return the name of an image; the bytes themselves if they are not one."""
        kind = _kind_of(value, declared)
        if not kind or not 0 < len(value) <= LARGEST_IMAGE or len(self.found) == MOST_IMAGES:
            return value
        data = base64.b64encode(value).decode()
        self.found.append(ImageContent(type="image", data=data, mime_type=kind))
        return f"image {len(self.found)}: {kind}, {len(value)} bytes"


def _kind_of(value: bytes, declared: Any) -> str:
    """Return the media type of an image; empty if the bytes are not one."""
    if isinstance(declared, str) and declared.startswith("image/"):
        return declared
    if value[:4] == b"RIFF" and value[8:12] == b"WEBP":
        return "image/webp"
    return next((kind for start, kind in _BEGINNINGS.items() if value.startswith(start)), "")
