"""The contract of all transports, over Zenoh without ROS, with fibaction at both ends: a session
each.
"""

from __future__ import annotations

import pytest

from tests.support.contract_over_ros import contract_over

globals().update(contract_over("zenoh", "&mode=peer"))
pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("router")]
