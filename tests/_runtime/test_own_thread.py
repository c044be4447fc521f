from __future__ import annotations

from threading import Thread

import anyio
import pytest

from fibaction._runtime.own_thread import OwnThread

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
