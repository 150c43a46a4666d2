"""The local server: the page's files, and a websocket for its one driver.

The network runs in a thread of its own; the event loop ticks, and never waits for it.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from socket import create_server
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.web import Application

from pipeline.drive import messages
from pipeline.drive.access import LOOPBACK, Access
from pipeline.drive.assets import Asset, read_assets
from pipeline.drive.car import RELEASED, TICK_S, Controls
from pipeline.drive.drive import Drive
from pipeline.drive.garage import Garage
from pipeline.drive.handlers import Driver, Files
from pipeline.drive.messages import ControlMessage, OpenMessage, PageMessage
from pipeline.engine import signals

MOST_BEHIND_S = 0.25
"""After a longer pause of the machine the clock goes on from now."""
LOOK_S = 0.05
"""How often it looks for a signal."""
STATE_TICKS = 10
MAX_LOGGED = 1000
"""Refusals beyond are not logged: nobody fills a disk from outside."""


class DriveServer:
    """One garage, one drive, one driver.

    Attributes:
        access: Who may talk to it.
        assets: Files that it serves.
    """

    def __init__(
        self, garage: Garage, number: int, seed: int, log: Callable[[str], None]
    ) -> None:
        self._garage, self._number, self._seed = garage, number, seed
        self._log, self._logged = log, 0
        self.assets: Mapping[str, Asset] = read_assets(garage.weights)
        self._worker = ThreadPoolExecutor(1, "infgen-world")
        self._drive: Drive | None = None
        self._driver: Driver | None = None
        self._controls: Controls = RELEASED
        self._paused, self._announced, self._loading = False, -1, False
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self, port: int, opened: Callable[[str], None]) -> None:
        """Serve until a signal arrives.

        Args:
            port: Where to listen; 0 for any free one.
            opened: Called with the address once it can be opened.

        Raises:
            OSError: if the port is taken.
            ValueError: if the first scene cannot be simulated.
        """
        listening = create_server((LOOPBACK, port))  # Closed if the port is taken.
        listening.setblocking(False)
        self.access = Access.at(listening.getsockname()[1])
        server = HTTPServer(self._application(), max_header_size=8192, max_body_size=1024)
        server.add_socket(listening)
        try:
            await self._load(self._number, self._seed)
            opened(self.access.url)
            await self._tick_until_stopped()
        finally:
            server.stop()
            for task in list(self._tasks):
                task.cancel()
            if self._driver is not None:
                self._driver.close(1001, "the server stops")
            await server.close_all_connections()
            self._worker.shutdown(cancel_futures=True)

    def refuse(self, what: str) -> None:
        """Log what was refused."""
        self._logged += 1
        if self._logged <= MAX_LOGGED:
            self._log(f"refused: {what}")

    def seat(self, driver: Driver) -> bool:
        """Let a page drive, if no other does."""
        if self._driver is not None or self._drive is None:
            return False
        self._driver, self._controls, self._paused = driver, RELEASED, False
        self._show_scene()
        return True

    def leave(self, driver: Driver) -> None:
        """Let the driver go: the world waits for the next one."""
        if self._driver is driver:
            self._driver, self._controls = None, RELEASED

    def receive(self, driver: Driver, message: PageMessage) -> None:
        """Do what the driver says; others have no say."""
        if self._driver is not driver:
            return
        if isinstance(message, ControlMessage):
            self._controls = message.controls
            if self._drive is not None and self._controls != RELEASED:
                self._drive.take_wheel()
        elif isinstance(message, OpenMessage):
            if not self._loading:
                self._begin(self._open(message.scene, message.seed))
        elif self._drive is not None:
            self._press(message.button, self._drive)

    def _press(self, button: str, drive: Drive) -> None:
        if button in ("pause", "resume"):
            self._paused = button == "pause"
        elif button == "wheel":
            drive.take_wheel()
        elif button == "network":
            drive.hand_back()
        elif button == "shift":
            drive.shift()
        elif button == "save":
            self._begin(self._save(drive))
        self._send(messages.state_message(drive, paused=self._paused))

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _open(self, number: int, seed: int) -> None:
        self._send(messages.note_message("loading", "the scene is read"))
        try:
            await self._load(number, seed)
        except ValueError as error:
            self._send(messages.note_message("error", f"{error}; choose another scene"))
        else:
            self._show_scene()

    async def _load(self, number: int, seed: int) -> None:
        self._loading = True
        try:
            work = asyncio.get_running_loop().run_in_executor(
                self._worker, self._garage.start, number, seed, self._worker.submit
            )
            drive = await work
        finally:
            self._loading = False
        self._drive, self._number, self._announced = drive, number, -1
        self._controls, self._paused = RELEASED, False

    async def _save(self, drive: Drive) -> None:
        try:
            folder = await asyncio.to_thread(self._garage.save, drive)
        except (ValueError, OSError) as error:
            self._log(f"not saved: {error}")
            self._send(messages.note_message("error", f"not saved: {error}"))
            return
        self._log(f"saved {folder}")
        self._send(messages.note_message("saved", str(folder)))

    def _show_scene(self) -> None:
        if self._drive is None:
            return
        world, ids = self._drive.world, self._garage.scenes.ids
        self._announced = -1
        self._send(messages.scene_message(world, ids, self._number))
        self._announce(self._drive)
        self._send(messages.state_message(self._drive, paused=self._paused))

    async def _tick_until_stopped(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = look_s = loop.time()
        ticks = 0
        while True:
            if loop.time() >= look_s:
                look_s = loop.time() + LOOK_S
                if signals.pending_signal():
                    return
            due_s = max(due_s + TICK_S, loop.time() - MOST_BEHIND_S)
            await asyncio.sleep(max(0.0, due_s - loop.time()))
            drive = self._drive
            if drive is None or self._driver is None or self._loading:
                continue
            ticks += 1
            if not self._paused:
                self._tick(drive)
            if ticks % STATE_TICKS == 0:
                self._send(messages.state_message(drive, paused=self._paused))

    def _tick(self, drive: Drive) -> None:
        moment = drive.tick(self._controls)
        self._announce(drive)
        if moment is not None:
            self._send(messages.ego_message(moment, drive))

    def _announce(self, drive: Drive) -> None:
        """Send token steps that the page has not seen, the next one once it is there."""
        for step in (drive.shown, drive.coming):
            if step is not None and step.token > self._announced:
                self._announced = step.token
                self._send(messages.frame_message(drive.world, step))

    def _send(self, text: str) -> None:
        if self._driver is not None:
            self._driver.send(text)

    def _application(self) -> Application:
        words = {"server": self}
        return Application(
            [(r"/([^/]+)/line", Driver, words), (r"/([^/]*)/?(.*)", Files, words)],
            websocket_max_message_size=messages.MAX_BYTES,
            log_function=lambda _: None,
        )


async def serve(
    garage: Garage,
    number: int,
    seed: int,
    port: int,
    opened: Callable[[str], None],
    log: Callable[[str], None],
) -> None:
    """Serve drives until a signal arrives; see ``DriveServer``."""

    def stamped(line: str) -> None:
        log(f"{time.strftime('%H:%M:%S')} {line}")

    await DriveServer(garage, number, seed, stamped).run(port, opened)
