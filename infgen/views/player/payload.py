"""A film as the text that the player's page carries, and back."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from infgen.clock import CLOCK
from infgen.views.player.columns import PayloadError, pack_columns, unpack_columns
from infgen.views.player.motion import PER_M, PER_RAD, Runs, from_runs, to_runs
from infgen.views.scene.drawn_map import DrawnMap, Lights
from infgen.views.scene.view_model import Showing, ViewModel

VERSION = 1


def pack(view_model: ViewModel) -> str:
    """Write a film as text of base64's letters only."""
    columns = {**_map_columns(view_model.drawn_map), **_light_columns(view_model.lights)}
    for at, showing in enumerate(view_model.showings):
        columns |= {f"{at}.{k}": v for k, v in _showing_columns(showing).items()}
    return pack_columns(_about(view_model), columns)


def unpack(text: str) -> ViewModel:
    """Read a film back: positions to a centimetre, headings to a milliradian.

    Raises:
        PayloadError: if the text is not what ``pack`` writes.
    """
    about, columns = unpack_columns(text)
    if about.get("version") != VERSION:
        raise PayloadError(f"payload version {about.get('version')}, expected {VERSION}")
    return ViewModel(
        scenario_id=about["scene"],
        now=about["now"],
        weights=about["weights"],
        drawn_map=_read_map(columns),
        lights=_read_lights(columns, about["lightSteps"]),
        showings=tuple(
            _read_showing(each, columns, f"{at}.")
            for at, each in enumerate(about["showings"])
        ),
    )


def _about(view_model: ViewModel) -> Mapping[str, Any]:
    return {
        "version": VERSION,
        "scene": view_model.scenario_id,
        "now": view_model.now,
        "weights": view_model.weights,
        "stepS": CLOCK.step_s,
        "lightSteps": view_model.lights.state.shape[1],
        "perM": PER_M,
        "perRad": PER_RAD,
        "showings": [
            {
                "name": showing.name,
                "ego": showing.ego,
                "agents": len(showing.id),
                "steps": showing.num_steps,
            }
            for showing in view_model.showings
        ],
    }


def _map_columns(drawn: DrawnMap) -> dict[str, np.ndarray]:
    return {
        "map.look": drawn.look,
        "map.bridge": drawn.bridge.astype(np.int8),
        "map.length": np.diff(drawn.offsets).astype(np.int32),
        **_differences("map", drawn.xy_m),
    }


def _read_map(columns: Mapping[str, np.ndarray]) -> DrawnMap:
    return DrawnMap(
        look=columns["map.look"],
        bridge=columns["map.bridge"].astype(bool),
        offsets=np.cumsum([0, *columns["map.length"]], dtype=np.int64),
        xy_m=_sums("map", columns),
    )


def _light_columns(lights: Lights) -> dict[str, np.ndarray]:
    return {
        **_differences("lights", lights.xy_m),
        "lights.heading": np.rint(lights.heading_rad * PER_RAD).astype(np.int16),
        "lights.state": lights.state.reshape(-1),
    }


def _read_lights(columns: Mapping[str, np.ndarray], steps: int) -> Lights:
    heading = columns["lights.heading"]
    return Lights(
        xy_m=_sums("lights", columns),
        heading_rad=(heading / PER_RAD).astype(np.float32),
        state=columns["lights.state"].reshape(len(heading), steps),
    )


def _showing_columns(showing: Showing) -> dict[str, np.ndarray]:
    runs = to_runs(showing.pose, showing.valid)
    size_cm = np.rint(showing.size_lw_m * PER_M).astype(np.int16)
    return {
        "id": showing.id,
        "agent_type": showing.agent_type,
        "role": showing.role,
        "length": size_cm[:, 0],
        "width": size_cm[:, 1],
        "last": showing.last_step,
        "run.agent": runs.agent,
        "run.step": runs.step,
        "run.length": runs.length,
        **{f"run.{axis}": runs.start[:, at] for at, axis in enumerate("xyh")},
        **{f"change.{axis}": runs.change[:, at] for at, axis in enumerate("xyh")},
    }


def _read_showing(
    about: Mapping[str, Any], columns: Mapping[str, np.ndarray], prefix: str
) -> Showing:
    own = {
        name.removeprefix(prefix): values
        for name, values in columns.items()
        if name.startswith(prefix)
    }
    runs = Runs(
        agent=own["run.agent"],
        step=own["run.step"],
        length=own["run.length"],
        start=np.stack([own[f"run.{axis}"] for axis in "xyh"], axis=-1),
        change=np.stack([own[f"change.{axis}"] for axis in "xyh"], axis=-1),
    )
    pose, valid = from_runs(runs, about["agents"], about["steps"])
    size_cm = np.stack([own["length"], own["width"]], axis=-1)
    return Showing(
        name=about["name"],
        ego=about["ego"],
        id=own["id"],
        agent_type=own["agent_type"],
        role=own["role"],
        size_lw_m=(size_cm / PER_M).astype(np.float32),
        pose=pose,
        valid=valid,
        last_step=own["last"],
    )


def _differences(name: str, xy_m: np.ndarray) -> dict[str, np.ndarray]:
    """Points in centimetres, each as its difference to the one before."""
    whole = np.rint(xy_m.astype(np.float64) * PER_M).astype(np.int32)
    steps = np.diff(whole, axis=0, prepend=np.int32(0))
    return {f"{name}.x": steps[:, 0], f"{name}.y": steps[:, 1]}


def _sums(name: str, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    steps = np.stack([columns[f"{name}.x"], columns[f"{name}.y"]], axis=-1)
    return (np.cumsum(steps, axis=0, dtype=np.int64) / PER_M).astype(np.float32)
