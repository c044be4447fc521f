"""JSON data by the JSON Schema of a peer, checked within bounds; and TypeScript from a schema."""
