"""JSON data by the JSON Schema of a peer, checked within bounds; and TypeScript from a schema.

A caller uses `payload`: its `JsonCodec` makes the payload of a goal from JSON, and JSON of a
payload. `turns` has the thread in which large documents are worked on.

`json_schema` reads a schema once. `check` says whether data matches it, with `keywords` for single
values; `steps` has the numbers that bound the work. `conversion` makes the value that is sent, with
defaults; `shapes` does both at once for the schemas of most types. `mismatch` is one reason why
data does not match, and `mismatch_texts` the sentences for it. `typescript` uses none of these.
"""
