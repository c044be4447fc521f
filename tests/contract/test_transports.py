"""The public part of the contract: `fibaction.testing.contract`."""

from fibaction.testing.contract.transports import *  # noqa: F403
