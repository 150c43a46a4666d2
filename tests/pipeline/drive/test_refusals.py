"""What the server refuses, over real sockets: each refusal is logged.

Together they take more than ten seconds; the rules themselves are in ``test_access.py``.
"""

import asyncio
import json
import struct

import pytest

from pipeline.drive.messages import MAX_BYTES
from tests.pipeline.drive.visitor import GAS, closed, hear

pytestmark = pytest.mark.slow


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
