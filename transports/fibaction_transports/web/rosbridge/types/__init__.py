"""Messages of rosbridge as payloads, and type definitions as JSON Schemas."""
