"""How hypothesis runs here: a found example is printed so that it can be replayed."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

settings.register_profile(
    "fibaction",
    # `make test-pythons` and `make test-lowest` ask for few: they look for what another version of
    # Python or of a library does otherwise.
    max_examples=int(os.environ.get("FIBACTION_EXAMPLES", "100")),
    # Machines that run tests are shared: time says nothing about the code.
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=False,
    print_blob=True,
)
settings.load_profile("fibaction")
