"""`wait`: until an action is served."""

from __future__ import annotations

import anyio
import pytest

from fibaction import AuthenticationFailed, serve
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import wait as module
from fibaction.cli.verbs.wait import wait
from tests.cli.conftest import Run
from tests.cli.served import Served, counter


def test_an_action_that_is_served_is_not_waited_for(here: Run, url: str) -> None:
    assert here("wait", "/fibonacci", "wait", url=url) == (0, "", "")


def test_an_action_that_does_not_come_is_an_error(here: Run, tcp: str, nobody: str) -> None:
    # Long enough for a busy machine to hear of the one that is served.
    assert here("wait", "wait", "b", "a", "-t", "3", url=tcp) == (
        ExitCode.UNREACHABLE,
        "",
        "Error: /a, /b: not served within 3 s\n",
    )
    code, _, err = here("wait", "wait", "-t", "0.01", url=nobody)
    assert (code, err) == (ExitCode.UNREACHABLE, "Error: /wait: not served within 0.01 s\n")


@pytest.mark.asyncio
async def test_a_server_that_starts_later_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LOOK_PAUSE", 0.001)
    server = counter("count")
    with anyio.fail_after(10):
        async with serve(counter("reserve"), "tcp://127.0.0.1:0") as (url,):
            pass  # its port is free again
        async with anyio.create_task_group() as tasks:

            async def start() -> None:
                await anyio.wait_all_tasks_blocked()
                async with serve(server, url):
                    await found.wait()

            found = anyio.Event()
            tasks.start_soon(start)
            assert await wait(url, ["count"], None) == 0
            found.set()


@pytest.mark.asyncio
async def test_a_server_that_rejects_the_client_is_not_waited_for() -> None:
    served = Served()
    served.error = AuthenticationFailed("wrong token")
    with pytest.raises(AuthenticationFailed):
        await module._served(served.connection)
