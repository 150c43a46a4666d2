"""The server as others see it: real sockets, real requests.

Together they take more than ten seconds.
"""

import asyncio
import json
import socket

import pytest

from pipeline.drive.assets import PAGE
from tests.pipeline.drive.visitor import GAS, closed, hear

pytestmark = pytest.mark.slow


def test_the_page_and_its_files_are_served_with_a_strict_policy(visit):
    async def talk(visitor):
        page = await visitor.get()
        assert page.code == 200
        policy = page.headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self';")
        assert "unsafe" not in policy
        assert page.headers["Cache-Control"] == "no-store"
        assert "Server" not in page.headers
        for name in visitor.server.assets:
            assert (await visitor.get(name)).body == visitor.server.assets[name].data
        assert visitor.log == []

    visit(talk)


def test_it_listens_at_the_loopback_address_only(visit):
    async def talk(visitor):
        port = visitor.server.access.port
        names = {row[4][0] for row in socket.getaddrinfo(socket.gethostname(), port)}
        for name in names - {"127.0.0.1"}:
            family = socket.AF_INET6 if ":" in name else socket.AF_INET
            with socket.socket(family) as other:
                assert other.connect_ex((name, port)) != 0
        with open("/proc/net/tcp") as table:
            listening = [row.split()[1] for row in table if row.split()[3] == "0A"]
        here = [place for place in listening if place.endswith(f":{port:04X}")]
        assert here == [f"0100007F:{port:04X}"]

    visit(talk)


def test_keys_move_the_ego_and_frames_come(visit):
    async def talk(visitor):
        line = await visitor.line()
        scene = await hear(line, "scene")
        assert scene["seed"] == 0
        assert await hear(line, "frame")
        assert not (await hear(line, "state"))["wheel"]
        line.write_message(json.dumps(GAS))
        while not (await hear(line, "state"))["wheel"]:
            pass
        first = await hear(line, "ego")
        for _ in range(40):
            last = await hear(line, "ego")
        assert last["speed"] > first["speed"] + 1
        assert last["step"] > first["step"]

    visit(talk)


def test_one_page_drives_at_a_time(visit):
    async def talk(visitor):
        first = await visitor.line()
        await hear(first, "scene")
        second = await visitor.line()
        second.write_message(json.dumps({"type": "press", "button": "pause"}))
        assert await closed(second) == 1013
        assert "a drive is under way" in visitor.log[0]
        assert not (await hear(first, "state"))["paused"]
        first.close()
        await asyncio.sleep(0.2)
        third = await visitor.line()
        await hear(third, "scene")

    visit(talk)


def test_a_pause_stops_time_and_a_line_that_is_cut_too(visit):
    async def talk(visitor):
        line = await visitor.line()
        line.write_message(json.dumps({"type": "press", "button": "pause"}))
        while not (state := await hear(line, "state"))["paused"]:
            pass
        await asyncio.sleep(0.3)
        assert (await hear(line, "state"))["seconds"] == state["seconds"]
        line.close()
        await asyncio.sleep(0.3)
        again = await visitor.line()
        assert (await hear(again, "state"))["seconds"] <= state["seconds"] + 0.1
        assert not (await hear(again, "state"))["paused"]

    visit(talk)


def test_another_scene_and_another_seed_are_begun(visit):
    async def talk(visitor):
        line = await visitor.line()
        first = await hear(line, "scene")
        other = (first["number"] + 1) % len(first["scenes"])
        line.write_message(json.dumps({"type": "open", "scene": other, "seed": 5}))
        second = await hear(line, "scene")
        assert (second["number"], second["seed"]) == (other, 5)
        assert second["payload"] != first["payload"]
        assert (await hear(line, "state"))["seconds"] < 0.5

        line.write_message(json.dumps({"type": "open", "scene": 10**6, "seed": 0}))
        assert "scene 1000000, expected 0 to" in (await hear(line, "error"))["text"]
        assert (await hear(line, "ego"))["step"] > 10  # The drive goes on.

    visit(talk)


def test_a_drive_without_half_a_second_is_not_saved(visit):
    async def talk(visitor):
        line = await visitor.line()
        line.write_message(json.dumps({"type": "press", "button": "save"}))
        said = (await hear(line, "error"))["text"]
        assert said.startswith("not saved: nothing was driven yet")

    visit(talk)


def test_all_files_of_the_page_are_among_the_assets(visit):
    from importlib.resources import files  # noqa: PLC0415

    async def talk(visitor):
        own = {
            path.name
            for path in files("infgen.views.drive").iterdir()
            if path.name.endswith((".js", ".css"))
        }
        assert own <= set(visitor.server.assets)
        assert PAGE in visitor.server.assets

    visit(talk)
