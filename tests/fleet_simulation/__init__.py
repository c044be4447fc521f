"""A simulation of fleets: workers, clients and brokers in one process, on virtual time.

    python -m tests.fleet_simulation --seconds 60

The workers and clients are the shipped code, on the brokers of `tests.support.memory_broker`. A
seed decides what happens: which goals are sent and canceled, which workers are killed, cut off from
the brokers and started again, and which answers are lost or late. `world` runs a seed, and
`invariants` says what must hold.
"""
