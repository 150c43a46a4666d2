"""``infgen towns``: synthetic driving logs as WOMD records, file by file, on all cores.

A file is written whole or not at all, and files that are there are kept: a run that was
killed goes on where it stopped. What the files hold depends on the seed, not on who made
them, nor on how many scenes there are of each.
"""

import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from infgen.errors import ConfigError
from pipeline.engine import signals
from pipeline.engine.atomic import PARTIAL, write_file, write_json
from pipeline.engine.events import Event
from pipeline.engine.locks import locked

if TYPE_CHECKING:
    from infgen.sources.towns.variety import Variety

VERSION = 7
"""Raised when the same order would give other bytes."""
SHORTEST_S, LONGEST_S = 2.1, 600.0
STEPS_PER_S = 10


@dataclass(frozen=True, slots=True)
class Order:
    """Which towns are written, and where to.

    Attributes:
        out: Folder to write to; made if need be.
        scenes: How many.
        seconds: Length of each; 9.1 s are 91 steps, as WOMD has them.
        seed: With the split, the length and its number it decides a scene.
        split: First part of the file names.
        scenes_per_file: Scenes of each file but perhaps the last.
        jobs: Processes that work side by side; 0 for one per core.
        variety: How much towns differ, by name (``infgen.sources.towns.variety``).
        scenes_per_town: Scenes of each town, the first ones of those that the variety has;
            0 for all of them. Scenes of one town have its streets and demand in common, so
            many towns with one scene each tell more than as many scenes of few.
    """

    out: Path
    scenes: int
    seconds: float
    seed: int
    split: str
    scenes_per_file: int
    jobs: int = 0
    variety: str = "basic"
    scenes_per_town: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be made.

        Raises:
            ConfigError: naming the setting.
        """
        if self.scenes < 1 or self.scenes_per_file < 1:
            raise ConfigError(
                f"{self.scenes} scenes, {self.scenes_per_file} per file; "
                "expected 1 or more of each"
            )
        if not SHORTEST_S <= self.seconds <= LONGEST_S:
            raise ConfigError(
                f"scenes of {self.seconds:g} s; expected {SHORTEST_S:g} to {LONGEST_S:g}"
            )
        if self.jobs < 0:
            raise ConfigError(f"{self.jobs} jobs; expected 1 or more, or 0 for all cores")
        if self.variety not in _varieties():
            raise ConfigError(
                f"towns of variety {self.variety!r}; expected {' or '.join(_varieties())}"
            )
        most = _varieties()[self.variety].scenes_per_town
        if not 0 <= self.scenes_per_town <= most:
            raise ConfigError(
                f"{self.scenes_per_town} scenes per town; variety {self.variety} has "
                f"1 to {most}, or 0 for all"
            )

    @property
    def num_steps(self) -> int:
        """Steps of each scene."""
        return round(self.seconds * STEPS_PER_S)

    @property
    def paths(self) -> list[Path]:
        """Files to write, named as WOMD names its files."""
        count = -(-self.scenes // self.scenes_per_file)
        return [
            self.out / f"{self.split}.tfrecord-{shard:05d}-of-{count:05d}.gz"
            for shard in range(count)
        ]


@dataclass(frozen=True, slots=True)
class Part:
    """One file of an order."""

    path: Path
    split: str
    seed: int
    num_steps: int
    first: int
    count: int
    variety: str
    scenes_per_town: int


@dataclass(frozen=True, slots=True)
class Written:
    """What was written.

    Attributes:
        out: Folder.
        files: Their names.
        scenes: How many scenes they hold.
        before: Files that an earlier run had written.
        bytes: Of all files.
    """

    out: str
    files: list[str]
    scenes: int
    before: int
    bytes: int

    def to_json(self) -> dict[str, Any]:
        """Everything, by name."""
        return asdict(self)


def write_towns(order: Order, tell: Callable[[Event], None] = lambda _: None) -> Written:
    """Write all files of an order that are not there yet.

    Raises:
        ConfigError: if the folder holds towns of another order.
        LockedError: if another process writes there.
        SumoError: if SUMO is missing or fails.
    """
    from infgen.sources.towns.sumo import check_installed  # noqa: PLC0415

    if not all(path.is_file() for path in order.paths):
        check_installed()
    with locked(order.out / f"{order.split}.towns.lock"):
        _begin(order)
        missing = [part for part in _parts(order) if not part.path.is_file()]
        before = len(order.paths) - len(missing)
        _say(tell, "work-started", units=len(order.paths), made=before)
        for path in _made(missing, order.jobs or len(os.sched_getaffinity(0))):
            _say(tell, "unit-done", unit=path.name)
    return Written(
        out=str(order.out),
        files=[path.name for path in order.paths],
        scenes=order.scenes,
        before=before,
        bytes=sum(path.stat().st_size for path in order.paths),
    )


def write_part(part: Part) -> Path:
    """Write one file, whole or not at all."""
    from infgen.sources.towns.numbering import draw_scenes  # noqa: PLC0415
    from infgen.sources.womd_write import encode_scenario, tfrecord  # noqa: PLC0415

    variety, each = _varieties()[part.variety], part.scenes_per_town
    scenes = draw_scenes(
        part.seed, part.split, part.num_steps, part.first, part.count, variety, each
    )
    records = [encode_scenario(scene) for scene in scenes]
    write_file(part.path, tfrecord(records, zipped=True))
    return part.path


def _begin(order: Order) -> None:
    """Note in the folder what it is for, and clear what a killed run left half written.

    Raises:
        ConfigError: if it is for something else.
    """
    for left in order.out.glob(f"{order.split}.*{PARTIAL}"):
        left.unlink()
    asked: dict[str, object] = {
        "version": VERSION,
        "scenes": order.scenes,
        "steps": order.num_steps,
    }
    asked |= {"seed": order.seed, "scenes_per_file": order.scenes_per_file}
    asked |= {"variety": order.variety, "scenes_per_town": order.scenes_per_town}
    path = order.out / f"{order.split}.towns.json"
    if not path.is_file():
        write_json(path, asked)
        return
    # Towns that do not name these were written before there was a choice.
    before: dict[str, object] = {"variety": "basic", "scenes_per_town": 0}
    there = before | json.loads(path.read_text())
    for name, value in asked.items():
        if there.get(name) != value:
            raise ConfigError(
                f"{order.out} holds {order.split} towns made with {name} "
                f"{there.get(name)}, not {value}; remove them, or name another --out"
            )


def _varieties() -> "Mapping[str, Variety]":
    from infgen.sources.towns.variety import VARIETIES  # noqa: PLC0415  # Numpy: 0.1 s.

    return VARIETIES


def _parts(order: Order) -> Iterator[Part]:
    for shard, path in enumerate(order.paths):
        first = shard * order.scenes_per_file
        count = min(order.scenes_per_file, order.scenes - first)
        yield Part(
            path=path,
            split=order.split,
            seed=order.seed,
            num_steps=order.num_steps,
            first=first,
            count=count,
            variety=order.variety,
            scenes_per_town=order.scenes_per_town,
        )


def _made(parts: list[Part], jobs: int) -> Iterator[Path]:
    """Write files side by side; yield each as it is done. Requests to stop arrive here."""
    if jobs == 1 or len(parts) < 2:
        for part in parts:
            yield write_part(part)
            signals.raise_if_stopped()
        return
    # Each process starts anew: nothing of this one's state can decide what it makes.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        min(jobs, len(parts)), mp_context=context, initializer=_be_stoppable
    ) as pool:
        waiting: list[Future[Path]] = [pool.submit(write_part, part) for part in parts]
        try:
            for done in as_completed(waiting):
                yield done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _be_stoppable() -> None:
    """In a worker: let the parent decide when to stop, and then end at once."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end)


def _end(number: int, frame: FrameType | None) -> None:
    # An exception and no plain exit: SUMO is then stopped, and its files are removed.
    raise SystemExit(128 + number)


def _say(tell: Callable[[Event], None], event: str, **more: Any) -> None:
    tell({"event": event, "stage": "towns", **more})
