"""Deterministic simulation: the real server, client and wire code, in a world made from a seed.

    python -m tests.simulation --seconds 600      # as many scenarios as fit, from a fresh seed
    python -m tests.simulation --seed 42 --trace  # one scenario, with all its events
    make simulate

`generator` makes a `scenario` from a seed: a server, clients, their deeds, and the faults of the
network. A `world` runs it, on an event loop in virtual time (`loop`) over a `network` in memory,
and `invariants` checks the rules that hold in every run. No part reads a clock, a socket or
randomness of the machine, so a seed gives the same run in every process.

`faults` are small deliberate mistakes in the product; a test shows that each is found.
"""
