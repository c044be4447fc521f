"""The two forms of an executor, as the contract has them."""

from fibaction.testing.contract.forms import *  # noqa: F403
