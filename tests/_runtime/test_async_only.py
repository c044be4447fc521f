from __future__ import annotations

from threading import Thread

import anyio
import pytest

from fibaction._runtime.async_only import HomeLoop, OwnThread

WRONG = "used in thread 'other': call it in its own thread, for example with anyio.from_thread.run"


def errors_in_another_thread(own: OwnThread) -> list[str]:
    errors: list[str] = []

    def use() -> None:
        try:
            own.check()
        except RuntimeError as exc:
            errors.append(str(exc))

    thread = Thread(target=use, name="other")
    thread.start()
    thread.join()
    return errors


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_it_is_the_thread_of_the_task_that_makes_the_object(backend: str) -> None:
    async def make() -> OwnThread:
        return OwnThread()

    own = anyio.run(make, backend=backend)
    (error,) = errors_in_another_thread(own)
    assert "event loop of thread 'MainThread'" in error
    assert WRONG in error
    own.check()


def test_without_an_event_loop_it_is_the_thread_of_the_first_use() -> None:
    own = OwnThread()
    assert errors_in_another_thread(own) == []
    with pytest.raises(RuntimeError, match="thread 'one that has ended', and was used in thread"):
        own.check()


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_another_thread_calls_into_the_event_loop_as_long_as_it_runs(backend: str) -> None:
    homes: dict[str, HomeLoop] = {}

    async def here() -> bool:
        return homes["main"].is_here

    async def main() -> HomeLoop:
        home = homes["main"] = HomeLoop()
        assert home.is_here
        assert await anyio.to_thread.run_sync(home.run, here)
        assert not await anyio.to_thread.run_sync(lambda: home.is_here)
        return home

    home = anyio.run(main, backend=backend)
    with pytest.raises(RuntimeError, match="the event loop of the action server has ended"):
        home.run(here)
