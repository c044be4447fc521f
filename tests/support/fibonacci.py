"""The messages of Fibonacci and their action, as the contract has them."""

from fibaction.testing.contract.executors import *  # noqa: F403
