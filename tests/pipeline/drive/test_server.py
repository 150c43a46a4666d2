"""The server as others see it: real sockets, real requests.

Together they take more than ten seconds; the rules themselves are in ``test_access.py``.
"""

import asyncio
import json
import socket
import struct
from contextlib import asynccontextmanager, suppress

import pytest
from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import websocket_connect

from pipeline.drive.assets import PAGE
from pipeline.drive.messages import MAX_BYTES
from pipeline.drive.server import DriveServer

pytestmark = pytest.mark.slow
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}
GAS = {"type": "control", "throttle": 1, "brake": 0, "steer": 0}


class Visitor:
    """A client of a running server.

    Attributes:
        server: The server.
        url: Of its page.
        log: What it has logged.
    """

    def __init__(self, server, url, log):
        self.server, self.url, self.log, self.lines = server, url, log, []

    async def get(self, path="", url=None, **more):
        """Status and body, whatever the status."""
        client = AsyncHTTPClient(force_instance=True)
        request = HTTPRequest((url or self.url) + path, follow_redirects=False, **more)
        try:
            return await client.fetch(request, raise_error=False)
        finally:
            client.close()

    async def line(self, url=None, origin=None, **headers):
        """A websocket of the page's own origin, unless another is named."""
        url = (url or self.url).replace("http", "ws") + "line"
        own = f"http://127.0.0.1:{self.server.access.port}"
        named = {"Origin": own if origin is None else origin, **headers}
        headers = {name: value for name, value in named.items() if value}
        line = await websocket_connect(HTTPRequest(url, headers=headers))
        self.lines.append((line, line.protocol.stream))
        return line

    async def refused_line(self, url=None, origin=None, **headers):
        """Status of a request for a websocket that is refused."""
        own = f"http://127.0.0.1:{self.server.access.port}"
        named = {"Origin": own if origin is None else origin, **UPGRADE, **headers}
        named = {name: value for name, value in named.items() if value}
        return (await self.get("line", url, headers=named)).code


async def hear(line, kind):
    """The next message of a type."""
    while True:
        text = await asyncio.wait_for(line.read_message(), 20)
        assert text is not None, f"closed: {line.close_code} {line.close_reason}"
        message = json.loads(text)
        if message["type"] == kind:
            return message


async def closed(line):
    """Wait until a line is closed by the server; returns the code."""
    while await asyncio.wait_for(line.read_message(), 20) is not None:
        pass
    return line.close_code


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


def test_what_is_not_the_page_is_refused_and_logged(visit):
    async def talk(visitor):
        port = visitor.server.access.port
        root = f"http://127.0.0.1:{port}/"
        asked = [
            visitor.get(url=root),
            visitor.get(url=root + "wrong-token/"),
            visitor.get(url=root + "drive.js"),
            visitor.get(headers={"Host": f"evil.example:{port}"}),
            visitor.get("drive.js", headers={"Host": "evil.example"}),
            visitor.get(headers={"Origin": "http://evil.example"}),
            visitor.get(method="POST", body=""),
            visitor.get(method="DELETE"),
            visitor.get(method="OPTIONS"),
        ]
        for number, request in enumerate(asked, 1):
            answer = await request
            assert (answer.code, answer.body) == (403, b"refused\n")
            assert len(visitor.log) == number
            assert visitor.log[-1].startswith("refused: 127.0.0.1: ")
        assert visitor.server.access.token not in "".join(visitor.log)

    visit(talk)


@pytest.mark.parametrize(
    "name",
    [
        "server.py",
        "../server.py",
        "..%2fserver.py",
        "/etc/passwd",
        "page.html",
        "x/drive.js",
    ],
)
def test_no_other_file_is_served(visit, name):
    async def talk(visitor):
        answer = await visitor.get(name)
        assert answer.code in (403, 404)
        assert "refused: 127.0.0.1" in visitor.log[0]

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


def test_a_line_from_elsewhere_is_refused_and_logged(visit):
    async def talk(visitor):
        port = visitor.server.access.port
        root = f"http://127.0.0.1:{port}/"
        assert await visitor.refused_line(url=root) == 403
        assert await visitor.refused_line(url=root + "wrong-token/") == 403
        assert await visitor.refused_line(origin="http://evil.example") == 403
        assert await visitor.refused_line(origin="null") == 403
        assert await visitor.refused_line(origin="") == 403
        assert await visitor.refused_line(Host=f"evil.example:{port}") == 403
        assert len(visitor.log) == 6
        await visitor.line()

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
        assert "somebody drives already" in visitor.log[0]
        assert not (await hear(first, "state"))["paused"]
        first.close()
        await asyncio.sleep(0.2)
        third = await visitor.line()
        await hear(third, "scene")

    visit(talk)


@pytest.mark.parametrize(
    "garbage",
    ["", "{}", '{"type":"press","button":"exit"}', b"\x00\xff", "x" * 200],
    ids=["empty", "no type", "no such button", "bytes", "no json"],
)
def test_garbage_is_refused_logged_and_the_page_let_go(visit, garbage):
    async def talk(visitor):
        line = await visitor.line()
        await hear(line, "scene")
        line.write_message(garbage, binary=isinstance(garbage, bytes))
        assert await closed(line) == 1008
        assert len(visitor.log) == 1
        assert visitor.log[0].startswith("refused: 127.0.0.1: ")
        again = await visitor.line()  # The seat is free.
        await hear(again, "scene")

    visit(talk)


def frame(first, payload):
    """A websocket frame as a page sends it; its mask is zero."""
    return bytes([first, 0x80 | len(payload)]) + bytes(4) + payload


TEXT, FIRST_OF_TEXT, MIDDLE, LAST, RESERVED = 0x81, 0x01, 0x00, 0x80, 0xC1
TOO_LARGE = {
    "by a byte": bytes([TEXT, 0xFE]) + struct.pack(">H", MAX_BYTES + 1),
    "by far": bytes([TEXT, 0xFF]) + struct.pack(">Q", 2**40),
    "in parts": frame(FIRST_OF_TEXT, b" " * 120) + frame(MIDDLE, b" " * 120) * 2,
}
NO_MESSAGE = {
    "no UTF-8": frame(TEXT, b"\xff\xfe"),
    "a reserved bit": frame(RESERVED, b"{}"),
    "an end without a beginning": frame(LAST, b"{}"),
}


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        *((sent, f"more than {MAX_BYTES} bytes") for sent in TOO_LARGE.values()),
        *((sent, "breaks the websocket protocol") for sent in NO_MESSAGE.values()),
    ],
    ids=[*TOO_LARGE, *NO_MESSAGE],
)
def test_what_is_no_message_or_too_large_is_refused_and_logged(visit, sent, why):
    async def talk(visitor):
        line = await visitor.line()
        await hear(line, "scene")
        await line.protocol.stream.write(sent)
        assert await closed(line) in (None, 1009)  # The line is cut, the code may be lost.
        (refused,) = visitor.log
        assert refused.startswith("refused: 127.0.0.1: ")
        assert why in refused
        again = await visitor.line()  # The seat is free.
        await hear(again, "scene")

    visit(talk)


def test_a_message_that_is_too_long_closes_the_line(visit):
    async def talk(visitor):
        line = await visitor.line()
        await hear(line, "scene")
        line.write_message("x" * 100_000)
        assert await closed(line) == 1009
        assert len(visitor.log) == 1

    visit(talk)


@pytest.mark.parametrize("code", [None, 1000, 1001])
def test_a_page_that_leaves_is_not_logged(visit, code):
    async def talk(visitor):
        line = await visitor.line()
        await hear(line, "scene")
        line.close(code)
        await closed(line)
        cut = await visitor.line()
        await hear(cut, "scene")
        cut.protocol.stream.close()
        await asyncio.sleep(0.2)
        last = await visitor.line()  # The server has seen that the seat is free.
        await hear(last, "scene")
        assert visitor.log == []

    visit(talk)


def test_a_flood_is_refused(visit):
    async def talk(visitor):
        line = await visitor.line()
        for _ in range(1000):
            line.write_message(json.dumps(GAS))
        assert await closed(line) == 1008
        assert "too many messages" in visitor.log[0]

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
