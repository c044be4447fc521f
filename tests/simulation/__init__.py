"""Deterministic simulation: the real server, client and wire code, in a world made from a seed.

    python -m tests.simulation --seconds 600      # as many scenarios as fit, from a fresh seed
    python -m tests.simulation --seed 42 --trace  # one scenario, with all its events
    python -m tests.simulation --store            # servers that keep their goals, and die
    make simulate

`generator` makes a `scenario` from a seed: a server, clients, their deeds, and the faults of the
network. Half of them have `hostile` clients as well, which send messages of their own making,
within the limits and beyond. In some the server has a store, and dies at any of its writes: before
it is kept, or before it is answered. A `world` runs the scenario, on an event loop in virtual time
(`loop`) over a `network` in memory. `invariants` checks the rules that hold in every run, `keeping`
those of a store, and `custody` looks at what the server holds. No part reads a clock, a socket or
randomness of the machine, so a seed gives the same run in every process.

`faults`, `hostile_faults`, `schedule_faults` and `store_faults` are small deliberate mistakes in
the product; a test shows that each is found.
"""
