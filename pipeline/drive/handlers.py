"""Requests to the server: files of the page, and the websocket of its driver.

Every request is checked before anything else: host, origin, token.
"""

import asyncio
import time
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from tornado.web import RequestHandler
from tornado.websocket import (
    WebSocketClosedError,
    WebSocketHandler,
    WebSocketProtocol,
    WebSocketProtocol13,
)

from pipeline.drive.access import MessageRate
from pipeline.drive.assets import PAGE
from pipeline.drive.messages import MAX_BYTES, MessageError, read_message

if TYPE_CHECKING:
    from pipeline.drive.server import DriveServer

MOST_UNSENT = 400
"""A page that takes ten seconds of messages no more is let go."""
POLICY_VIOLATION, MESSAGE_TOO_BIG, TRY_AGAIN_LATER = 1008, 1009, 1013


class _Checked(RequestHandler):
    """A request that is refused unless it is the page's own."""

    needs_origin = False

    def initialize(self, server: "DriveServer") -> None:
        """Take the server."""
        self.server = server

    def set_default_headers(self) -> None:
        """Send nothing about the server, and let nothing be kept."""
        self.clear_header("Server")
        self.set_header("Cache-Control", "no-store")
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Cross-Origin-Resource-Policy", "same-origin")
        self.set_header("Cross-Origin-Opener-Policy", "same-origin")

    def prepare(self) -> None:
        """Refuse what is not the page's own."""
        request = self.request
        why = self.server.access.refusal(
            request.headers.get("Host", ""),
            request.headers.get("Origin"),
            self.path_args[0] if self.path_args else "",
            needs_origin=self.needs_origin,
        )
        if why is None and request.method != "GET":
            why = f"method {request.method}, expected GET"
        if why is not None:
            self.refuse(why)
            self.set_status(HTTPStatus.FORBIDDEN)
            self.finish("refused\n")

    def refuse(self, why: str) -> None:
        """Log that something was refused."""
        self.server.refuse(f"{self.request.remote_ip}: {why}")


class Files(_Checked):
    """Files of the page."""

    def get(self, token: str, name: str) -> None:
        """Send a file by its fixed name."""
        asset = self.server.assets.get(name)
        if asset is None:
            self.refuse(f"no file {name[:80]!r}")
            self.set_status(HTTPStatus.NOT_FOUND)
            self.finish("no such file\n")
            return
        if name == PAGE and not self.request.path.endswith("/"):
            self.redirect(f"/{token}/")
            return
        self.set_header("Content-Type", asset.media_type)
        self.set_header("Content-Security-Policy", self.server.access.policy)
        self.finish(asset.data)


class Driver(_Checked, WebSocketHandler):
    """The websocket of a driver."""

    needs_origin = True

    def initialize(self, server: "DriveServer") -> None:
        """Take the server."""
        super().initialize(server)
        self._rate, self._unsent = MessageRate(time.monotonic()), 0

    def check_origin(self, origin: str) -> bool:
        """Allow: ``prepare`` has checked it."""
        return True

    def get_websocket_protocol(self) -> WebSocketProtocol | None:
        """Return the protocol of the line; what it refuses by itself is logged too."""
        made = super().get_websocket_protocol()
        if isinstance(made, WebSocketProtocol13):
            return _LoggedProtocol(self, made.params)
        return made

    def open(self, *args: str, **_: str) -> None:
        """Take the driver's seat, if it is free."""
        self.set_nodelay(True)
        if not self.server.seat(self):
            self.refuse("a drive is under way")
            self.close(TRY_AGAIN_LATER, "a drive is under way in another window")

    def on_message(self, message: str | bytes) -> None:
        """Read a message; a page that sends another than ours sends is let go."""
        try:
            if not self._rate.allows(time.monotonic()):
                raise MessageError("too many messages")
            read = read_message(message)
        except MessageError as error:
            self.refuse(str(error))
            self.server.leave(self)
            self.close(POLICY_VIOLATION, "a message was refused")
            return
        self.server.receive(self, read)

    def on_close(self) -> None:
        """Leave the driver's seat."""
        self.server.leave(self)

    def send(self, text: str) -> None:
        """Send a message; a page that no longer reads is let go."""
        if self._unsent > MOST_UNSENT:
            self.refuse("it does not read")
            self.server.leave(self)
            self.close(POLICY_VIOLATION, "too slow")
            return
        try:
            sent: Any = self.write_message(text)
        except WebSocketClosedError:
            self.server.leave(self)
            return
        self._unsent += 1
        asyncio.ensure_future(sent).add_done_callback(self._count_sent)

    def _count_sent(self, sent: "asyncio.Future[None]") -> None:
        self._unsent -= 1
        if not sent.cancelled():
            sent.exception()  # A page that went away is no error.


class _LoggedProtocol(WebSocketProtocol13):
    """The websocket protocol, which logs why it cuts a line.

    Tornado cuts the line without a word to its handler where a message is longer than
    allowed, is no text as its type says, or breaks the protocol.
    """

    def __init__(self, driver: Driver, params: Any) -> None:
        super().__init__(driver, mask_outgoing=False, params=params)
        self._refuse = driver.refuse

    def close(self, code: int | None = None, reason: str | None = None) -> None:
        """Close the line; tornado gives this code before it has read the message."""
        if code == MESSAGE_TOO_BIG and not self.server_terminated:
            self._refuse(f"a message of more than {MAX_BYTES} bytes")
        super().close(code, reason)

    def _abort(self) -> None:
        # A line that the page has left is closed already.
        if not self.server_terminated and not self.stream.closed():
            self._refuse("what it sent breaks the websocket protocol")
        super()._abort()
