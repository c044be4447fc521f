"""The task of asyncio that runs the caller."""

import asyncio  # noqa: TID251  # it is what the test is about
import sys

import anyio
import anyio.to_thread
import pytest

from fibaction.border.event_loop import asyncio_loop, asyncio_task, loop_clock


@pytest.mark.asyncio
async def test_whether_it_is_asyncio_is_known_everywhere() -> None:
    found: dict[str, bool] = {}

    async def look(where: str) -> None:
        found[where] = asyncio_task() is not None

    def elsewhere() -> None:
        found["nowhere"] = asyncio_task() is not None
        anyio.run(look, "trio", backend="trio")

    await look("asyncio")
    await anyio.to_thread.run_sync(elsewhere)
    done = anyio.Event()

    def callback() -> None:
        found["a guest"] = asyncio_task() is not None
        done.set()

    asyncio.get_running_loop().call_soon(callback)
    await done.wait()
    assert found == {"nowhere": False, "asyncio": True, "trio": False, "a guest": False}
    assert asyncio_task() is asyncio.current_task()


@pytest.mark.asyncio
@pytest.mark.parametrize("has_sniffio", [True, False])
async def test_the_loop_is_that_of_the_caller(
    has_sniffio: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has_sniffio:
        monkeypatch.setitem(sys.modules, "sniffio", None)
    assert asyncio_loop() is asyncio.get_running_loop()


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_the_clock_of_a_loop_is_that_of_anyio(backend: str) -> None:
    async def look() -> None:
        now = loop_clock()
        before = anyio.current_time()
        assert before <= now() <= anyio.current_time()
        await anyio.sleep(0.01)
        assert now() > before

    anyio.run(look, backend=backend)
