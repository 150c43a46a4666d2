"""A client of the drive's server: real sockets, real requests."""

import asyncio
import json

from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import websocket_connect

GAS = {"type": "control", "throttle": 1, "brake": 0, "steer": 0}
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


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
