"""What the tests of rosbridge have in common: most run over a socket and through an application."""

from __future__ import annotations

import pytest

from tests.transports.web.rosbridge.clients import Serving, over_asgi, over_sockets


@pytest.fixture(params=[over_sockets, over_asgi])
def serving(request: pytest.FixtureRequest) -> Serving:
    found: Serving = request.param
    return found
