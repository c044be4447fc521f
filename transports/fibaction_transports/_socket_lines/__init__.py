"""Lines over streams of bytes: sockets on asyncio and on anyio, TLS, and hosts to listen at.

Private: `tcp` and `web` have it in common.
"""
