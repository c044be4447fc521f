"""What is compared of a value, as the contract compares it."""

from fibaction.testing.contract.matching import *  # noqa: F403
