"""What page and server say to each other: JSON, one object a message.

What comes from the page is read strictly: a known type, exactly its fields, finite numbers
within their bounds, no more than ``MAX_BYTES``.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from infgen.rollout.population import EGO_ROW
from infgen.views.player.payload import pack
from infgen.views.scene.drawn_map import Lights, draw_map, find_lights
from infgen.views.scene.view_model import Role, Showing, ViewModel
from pipeline.drive.car import Controls
from pipeline.drive.drive import Drive, Moment
from pipeline.drive.world import World, WorldStep

MAX_BYTES = 256
"""Longest message of a page."""
MAX_SEED = 2**31 - 1
_STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

_Pedal = Annotated[float, Field(ge=0, le=1)]


class MessageError(ValueError):
    """A message that no page of ours sends."""


@dataclass(frozen=True, slots=True, config=_STRICT)
class ControlMessage:
    """What the driver holds down."""

    type: Literal["control"]
    throttle: _Pedal
    brake: _Pedal
    steer: Annotated[float, Field(ge=-1, le=1)]

    @property
    def controls(self) -> Controls:
        """The same for the car."""
        return Controls(self.throttle, self.brake, self.steer)


@dataclass(frozen=True, slots=True, config=_STRICT)
class PressMessage:
    """A button that was pressed."""

    type: Literal["press"]
    button: Literal["pause", "resume", "wheel", "network", "shift", "save"]


@dataclass(frozen=True, slots=True, config=_STRICT)
class OpenMessage:
    """A scene to begin, by its number in the list, and a seed."""

    type: Literal["open"]
    scene: Annotated[int, Field(ge=0)]
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]


PageMessage = ControlMessage | PressMessage | OpenMessage
_READER: TypeAdapter[PageMessage] = TypeAdapter(
    Annotated[PageMessage, Field(discriminator="type")]
)


def read_message(text: str | bytes) -> PageMessage:
    """Read a message of a page.

    Raises:
        MessageError: saying what is wrong with it.
    """
    if not isinstance(text, str):
        raise MessageError("expected text, got bytes")
    if len(text.encode("utf-8", "replace")) > MAX_BYTES:
        raise MessageError(f"{len(text)} characters, expected {MAX_BYTES} bytes at most")
    try:
        return _READER.validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "message"
        raise MessageError(f"{where}: {first['msg']}"[:MAX_BYTES]) from error


def scene_message(world: World, scenes: Sequence[str], number: int) -> str:
    """Show a scene with its history, and the choice of scenes."""
    scene = world.start.scene
    view_model = ViewModel(
        scenario_id=scene.scenario_id,
        now=scene.now,
        weights="",
        drawn_map=draw_map(scene.road_map),
        lights=_lights_at_now(world),
        showings=(_history(world),),
    )
    return _write(
        "scene",
        payload=pack(view_model),
        scenes=list(scenes),
        number=number,
        seed=world.start.seed,
        simulates=world.simulator.simulates,
        rules=world.simulator.settings.rules_in_words,
    )


def frame_message(world: World, step: WorldStep) -> str:
    """Say where all agents but the ego go in a token step."""
    present, moved = step.present.copy(), step.begun.moved
    present[EGO_ROW] = False
    rows = np.flatnonzero(present)
    number, path = moved.agent_number[0, rows], step.path[rows]
    logged = number < world.start.history.num_agents
    columns = {
        "id": world.ids(number).tolist(),
        "kind": moved.agent_type[0, rows].tolist(),
        "role": np.where(logged, Role.INITIAL, Role.INSERTED).tolist(),
        "removed": step.removed[rows].astype(int).tolist(),
        "size": _rounded(moved.size_lwh_m[0, rows, :2], 2),
        "path": _rounded(path.reshape(len(rows), step.path[0].size), 3),
    }
    return _write("frame", token=step.token, **columns)


def ego_message(moment: Moment, drive: Drive) -> str:
    """Say where the ego is."""
    car = drive.car
    return _write(
        "ego",
        step=round(moment.step, 3),
        pose=_rounded(moment.pose, 4),
        rate=_rounded(moment.rate, 4),
        speed=round(moment.speed_mps, 3),
        steer=round(car.steering_rad, 3) if car else 0.0,
    )


def state_message(drive: Drive, *, paused: bool) -> str:
    """Say how the drive stands: who drives, how many agents, how fast the world is."""
    shown, times_ms = drive.shown, 1000 * np.array(drive.step_s)
    p50_ms, p99_ms = np.percentile(times_ms, [50, 99])
    return _write(
        "state",
        paused=paused,
        wheel=drive.at_wheel,
        reverse=bool(drive.car and drive.car.reverse),
        agents=int(shown.present.sum()),
        inserted=drive.inserted,
        removed=drive.removed,
        seconds=round(drive.seconds, 2),
        recorded=drive.recorded_s,
        late=drive.late_ticks,
        steps=len(times_ms),
        p50=round(float(p50_ms), 1),
        p99=round(float(p99_ms), 1),
    )


def note_message(kind: Literal["saved", "error", "loading"], text: str) -> str:
    """Tell the driver something in words."""
    return _write(kind, text=text)


def _write(kind: str, /, **values: Any) -> str:
    text = json.dumps({"type": kind, **values}, separators=(",", ":"), allow_nan=False)
    return text


def _rounded(values: np.ndarray, digits: int) -> list[Any]:
    return np.round(values.astype(np.float64), digits).tolist()


def _lights_at_now(world: World) -> Lights:
    """Lights as the network sees them from now on: they stay as they are."""
    scene = world.start.scene
    lights = find_lights(scene)
    shown = {**asdict(lights), "state": lights.state[:, scene.now : scene.now + 1]}
    return Lights(**shown)


def _history(world: World) -> Showing:
    """The agents that are simulated, up to now, in the order of their numbers."""
    start, tracks = world.start, world.start.scene.tracks
    rows, span = start.logged_row, slice(0, world.start.scene.now + 1)
    pose = np.concatenate(
        [tracks.xyz_m[rows, span, :2], tracks.heading_rad[rows, span, None]], axis=-1
    )
    role = np.full(len(rows), Role.INITIAL, dtype=np.int8)
    role[start.history.ego] = Role.EGO
    return Showing(
        name="drive",
        ego=start.history.ego,
        id=start.history.track_id.astype(np.int32),
        agent_type=start.history.agent_type.astype(np.int8),
        role=role,
        size_lw_m=start.history.size_lwh_m[:, :2].astype(np.float32),
        pose=pose.astype(np.float32),
        valid=tracks.valid[rows, span],
        last_step=np.full(len(rows), span.stop, dtype=np.int16),
    )
