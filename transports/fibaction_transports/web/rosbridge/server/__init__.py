"""The server's half: clients of rosbridge as clients of the wire protocol."""
