"""JSON data by the JSON Schema of a peer, checked within bounds; and TypeScript from a schema.

A caller uses `payload`: its `JsonCodec` makes the payload of a goal from JSON, and JSON of a
payload. `turns` has the thread in which large documents are worked on.

`check` reads a schema once, compares data with its `parts` and makes the value that is sent, in one
pass, with `keywords` for single values and combinations of schemas; it bounds the work, too.
`mismatch_texts` has the sentences for what does not match. `typescript` uses none of these.
"""
