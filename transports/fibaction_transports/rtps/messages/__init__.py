"""The wire format of RTPS: packets, their submessages, and lists of parameters."""
