"""An executor that tests let go, and executors that fail, as the contract has them."""

from fibaction.testing.contract.executors import *  # noqa: F403
