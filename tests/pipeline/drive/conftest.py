"""A garage with the network of the package and a small built-in scene."""

import asyncio
import os
from concurrent.futures import Future
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from pipeline.commands.drive import Wanted, open_garage
from pipeline.drive.server import DriveServer
from pipeline.engine.layout import find_root
from pipeline.settings.request import complete_request
from tests.pipeline.drive.visitor import Visitor

SCENE = "95dff16c6d8f74e7"
"""13 agents at now."""


def wanted(root: Path, scene: str = SCENE, overrides=(), profile=None, **more) -> Wanted:
    request = complete_request(
        find_root(root),
        file=None,
        profile=profile,
        records=(),
        overrides=overrides,
        environ=os.environ,
    )
    return Wanted(request, request.stages({}), profile=profile, scene=scene, **more)


def at_once(work):
    """Do some work now: an executor without a thread."""
    done = Future()
    done.set_result(work())
    return done


@pytest.fixture(scope="session")
def opened(tmp_path_factory):
    """The garage, and the number of its first scene."""
    return open_garage(wanted(tmp_path_factory.mktemp("garage") / "root"))


@pytest.fixture
def begin(opened):
    """``begin(seed=0, submit=at_once)``: a drive through the small scene."""
    garage, number = opened

    def start(seed=0, submit=at_once):
        return garage.start(number, seed, submit)

    return start


@pytest.fixture
def visit(opened, tmp_path):
    """``visit(talk)``: run ``talk(visitor)`` against a server that runs meanwhile."""
    garage, number = opened

    @asynccontextmanager
    async def running():
        log, ready = [], asyncio.get_running_loop().create_future()
        server = DriveServer(garage, number, 0, log.append)
        task = asyncio.create_task(server.run(0, ready.set_result))
        await asyncio.wait([task, ready], return_when=asyncio.FIRST_COMPLETED)
        visitor = Visitor(server, await ready, log)
        yield visitor
        for line, stream in visitor.lines:
            line.close()
            await asyncio.sleep(0.05)  # The server sees it.
            stream.close()
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    def run(talk):
        async def whole():
            async with running() as visitor:
                return await talk(visitor)

        return asyncio.run(whole())

    return run
