"""Helpers for authors of transports and stores, beside the interfaces that they implement.

The transports that come with fibaction use the same modules, and nothing that is private:

- `event_loop`: background tasks, bulk work that leaves others their turns, asyncio under anyio;
- `peer_text`: loggers and excerpts for text that a peer has sent;
- `byte_budgets`: limits for the bytes that many parts hold together;
- `http_access`: which HTTP requests a server lets in;
- `plain_values`: type guards for data that comes from JSON.

The interfaces themselves are in `fibaction.border.abc`, with `Notifier`; feedback and statuses for
many followers are in `fibaction.feeds`.
"""
