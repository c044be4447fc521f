"""Both halves of a connection over any transport that moves frames.

`channel` is what a transport supplies; `link` is what both halves do with it; `serving` calls
endpoints for a client; `connecting` is an endpoint whose server is somewhere else.
"""
