"""Deterministic simulation: the real server, client and wire code, in a world made of one integer.

    python -m tests.simulation --seconds 600      # as many scenarios as fit, from a fresh seed
    python -m tests.simulation --seed 42 --trace  # one, and all that happens in it
    make simulate

`making` turns a seed into a `scenario`: a server, clients, what they do, and what goes wrong. A
`world` lets it happen, on an event loop in virtual time (`loop`) over a `network` in memory, and
the `invariants` say what must be true. Nothing reads a clock, a socket or chance of the machine, so
the same seed is the same run, in every process.

`faults` are small deliberate mistakes in the product; a test shows that each is found.
"""
