"""Messages of ROS 2 as bytes of CDR, and type hashes, made from interface files without ROS.

`dds://` uses it. Nothing here does I/O.

- `codec`: `CdrCodec`, which turns structs of `fibaction.interfaces` into payloads and back;
- `standard_messages`: the messages that all actions have in common, and the requests, responses and
  feedback that ROS makes of an action;
- `type_hashes`: RIHS01 of a type, a service or an action.
"""
