"""Which HTTP requests a server lets in: the path, the host, and the page that asks.

A browser lets every page open a WebSocket to every address, even to one of this machine. So every
server of HTTP or WebSocket needs these rules, which are in `fibaction._runtime.http_rules`. For
example:

    access = rules(host, "/", hosts=(), origins=(), has_tls=False)
    try:
        access.check(target, headers)
    except Refused as exc:
        answer(exc.status, str(exc))
"""

from fibaction._runtime.http_rules import HttpRules, Refused, bearer_in, headers_in, rules

__all__ = ["HttpRules", "Refused", "bearer_in", "headers_in", "rules"]
