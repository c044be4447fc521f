"""Names of actions for agents, made from the names of servers and actions.

Language models take letters, digits, `_` and `-`, and at most 64 of them. So `arm/pick` is
`arm-pick`, and on a server that is called `left` it is `left-arm-pick`.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from hashlib import blake2b

LONGEST = 64
"""Characters of a name."""


def action_name(server: str, action: str, taken: Collection[str]) -> str:
    """Return the name of an action, which is none of those that are taken.

    A name that is too long or taken ends with digits that depend on the server and the action only.
    """
    parts = [server, *action.lstrip("~").split("/")]
    name = re.sub(r"[^A-Za-z0-9_-]", "_", "-".join(part for part in parts if part))
    if name and len(name) <= LONGEST and name not in taken:
        return name
    digest = blake2b(f"{server}\n{action}".encode(errors="replace"), digest_size=4).hexdigest()
    return f"{name[: LONGEST - len(digest) - 1]}_{digest}"
