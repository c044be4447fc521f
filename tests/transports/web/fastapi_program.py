"""A program of FastAPI with a robot in it, for servers of ASGI."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio
from fastapi import FastAPI

from fibaction import ActionServer, GoalHandle, serve
from fibaction_transports.web import WebTransport
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result


async def count(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    yield Feedback([goal.request.order])
    await anyio.sleep(goal.request.order)
    yield Result([])


web = WebTransport()


@asynccontextmanager
async def lifespan(app: FastAPI) -> AsyncGenerator[None, None]:
    async with serve(ActionServer(FIBONACCI, count), web):
        yield


app = FastAPI(lifespan=lifespan)
app.mount("/robot", web)
