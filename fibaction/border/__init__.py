"""The interfaces that an author of a transport, a store or a watcher implements or calls.

The transports that come with fibaction use the same modules, and nothing that is private.

The interfaces, whose names are exported by `abc` and by `fibaction`:

- `abc`, `endpoints`, `streams`: endpoints, transports, and the streams of goals;
- `goal_store`, `watchers`: places where goals outlive their server, and objects that see them;
- `urls`: the transport of a URL, and its settings;
- `gateway`: transports that serve all actions of other servers, as they come and go.

Helpers:

- `event_loop`: background tasks, bulk work that leaves others their turns, asyncio under anyio;
- `peer_text`: loggers and excerpts for text that a peer has sent;
- `settings`: the settings of a transport, from keywords and from URLs;
- `byte_budgets`: limits for the bytes that many parts hold together;
- `http_access`: which HTTP requests a server lets in;
- `detached`: a task group that can leave tasks behind, for code that may refuse to end.

Feedback and statuses for many followers are in `fibaction.feeds`.
"""
