"""The messages of Fibonacci and their action, as the contract has them."""

from fibaction.testing.contract.fibonacci import *  # noqa: F403
