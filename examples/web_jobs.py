"""Jobs in a web application: progress that survives a reload of the page, and a stop button.

The application is FastAPI's. It makes reports, each in a job that takes a while. Its actions are
mounted, so that browsers start, follow and stop jobs without any code for it. The browser here is
Python's HTTP client, which does what a page does with `fetch` and `EventSource`.

It needs the extra `web`, FastAPI and uvicorn. `uvicorn web_jobs:app` serves it for real browsers.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager
from http.client import HTTPConnection
from typing import Any

import anyio
import uvicorn
from fastapi import FastAPI
from msgspec import Struct

from fibaction import GoalCanceled, Report, action, serve
from fibaction_transports.web import WebTransport

# The application


class Job(Struct):
    """A report to make, of so many pages."""

    title: str
    pages: int


class Progress(Struct):
    """The part that is done, in percent."""

    percent: int


@action
async def make_report(report: Report[Progress], job: Job) -> str:
    """Write one page after another."""
    page = 0
    try:
        for page in range(1, job.pages + 1):
            await anyio.sleep(0.05)  # for real work: `await anyio.to_process.run_sync(...)`
            await report(Progress(100 * page // job.pages))
    except asyncio.CancelledError:
        raise GoalCanceled(result=f"{job.title}.pdf, only a part") from None
    return f"{job.title}.pdf, {job.pages} pages"


jobs = WebTransport()


@asynccontextmanager
async def lifespan(app: FastAPI) -> AsyncGenerator[None, None]:
    """Serve the action as long as the application runs."""
    async with serve(make_report, jobs):
        yield


app = FastAPI(lifespan=lifespan)
app.mount("/jobs", jobs)


# The browser

GOALS = "/jobs/actions/make_report/goals"


class Browser:
    """A user's browser, at the address of the application."""

    def __init__(self, port: int) -> None:
        self._port = port

    def start(self, title: str, pages: int) -> str:
        """Start a job, and return its address."""
        return str(self._fetch("POST", GOALS, {"title": title, "pages": pages})["goal_id"])

    def stop(self, goal_id: str) -> None:
        """Press the stop button."""
        self._fetch("DELETE", f"{GOALS}/{goal_id}")

    def follow(self, goal_id: str, last: str = "") -> Generator[tuple[str, str, Any], None, None]:
        """Yield the events of a job after the last one that was seen: ID, kind and data."""
        connection = HTTPConnection("127.0.0.1", self._port, timeout=30)
        try:
            headers = {"last-event-id": last} if last else {}
            connection.request("GET", f"{GOALS}/{goal_id}/events", headers=headers)
            event = dict[str, str]()
            for line in connection.getresponse():
                name, _, value = line.decode().rstrip("\n").partition(": ")
                if name:
                    event[name] = value
                else:
                    yield event.get("id", ""), event["event"], json.loads(event["data"])
                    event.clear()
        finally:
            connection.close()

    def _fetch(self, method: str, path: str, body: object = None) -> Any:
        connection = HTTPConnection("127.0.0.1", self._port, timeout=30)
        try:
            text = None if body is None else json.dumps(body)
            connection.request(method, path, text, {"content-type": "application/json"})
            answer = connection.getresponse().read()
            return json.loads(answer) if answer else None
        finally:
            connection.close()


def use(browser: Browser) -> None:
    """Watch a job over a reload of the page, and stop another one."""
    job = browser.start("sales", pages=6)
    seen = ""
    for number, kind, data in browser.follow(job):
        if kind == "feedback":
            print(f"{data['percent']} %")
            seen = number
        if seen == "3":
            print("the page is reloaded")
            break
    for _, kind, data in browser.follow(job, seen):
        if kind == "feedback":
            print(f"{data['percent']} %")
        elif kind == "result":
            print(data["status"], data["result"])
    unwanted = browser.start("everything", pages=1000)
    for _, kind, data in browser.follow(unwanted):
        if kind == "feedback":
            browser.stop(unwanted)
        elif kind == "result":
            print(data["status"], data["result"])


async def main() -> None:
    """Serve the application at a free port, and use it."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = uvicorn.Server(uvicorn.Config(app, log_level=logging.WARNING))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(server.serve, [listener])
            await anyio.to_thread.run_sync(use, Browser(listener.getsockname()[1]))
            server.should_exit = True


if __name__ == "__main__":
    anyio.run(main)
