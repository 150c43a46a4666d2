"""Tracks of a ScenarioNet description."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64

from infgen.geometry import wrap_angle
from infgen.scene import AgentType
from infgen.sources.ids import integer_ids
from infgen.sources.scenarionet.datasets import Convention
from infgen.sources.scenarionet.parts import Part, part_of, text_of
from infgen.sources.scenarionet.pickles import array
from infgen.sources.tfrecord import RecordError
from infgen.sources.womd_tracks import WorldTracks

MAX_TRACKS = 20_000
MAX_STATES = 2_000_000
"""Tracks times steps: a crafted file must not fill the memory."""
_SIZES = ("length", "width", "height")
_LARGEST_ID = 2**31 - 1
_TYPES = {
    "VEHICLE": AgentType.VEHICLE,
    "PEDESTRIAN": AgentType.PEDESTRIAN,
    "CYCLIST": AgentType.CYCLIST,
}
"""All others are ``OTHER``: cones, barriers, unset."""


def track_ids(tracks: Mapping[str, Part]) -> dict[str, int]:
    """Integer ids of tracks, by name."""
    return integer_ids(tracks, _LARGEST_ID)


def read_tracks(
    tracks: Mapping[str, Part], num_steps: int, ego: str, convention: Convention
) -> WorldTracks:
    """Read all tracks.

    Raises:
        RecordError: if there are none, too many, or one has not as many states as there are
            steps.
    """
    if not tracks:
        raise RecordError("description has no tracks")
    if len(tracks) > MAX_TRACKS or len(tracks) * num_steps > MAX_STATES:
        raise RecordError(f"description has {len(tracks)} tracks of {num_steps} steps")
    xyz_m = np.zeros((len(tracks), num_steps, 3))
    heading_rad = np.zeros((len(tracks), num_steps))
    velocity_mps = np.zeros((len(tracks), num_steps, 2))
    size_lwh_m = np.zeros((len(tracks), num_steps, 3))
    valid = np.zeros((len(tracks), num_steps), bool)
    for row, (name, track) in enumerate(tracks.items()):
        state = part_of(track, "state", f"track {name[:40]}")
        position = _states(state, "position", name, num_steps)
        axes = min(3, position.shape[1])
        xyz_m[row, :, :axes] = position[:, :axes]
        heading_rad[row] = _states(state, "heading", name, num_steps)[:, 0]
        velocity_mps[row] = _columns(state, "velocity", name, num_steps, 2)
        for axis, size in enumerate(_SIZES):
            size_lwh_m[row, :, axis] = _states(state, size, name, num_steps)[:, 0]
        if name == ego and convention.ego_sideways:
            size_lwh_m[row] = _lengthwise(size_lwh_m[row])
        valid[row] = _states(state, "valid", name, num_steps)[:, 0] != 0
    if not convention.exact:
        heading_rad = _wrapped(heading_rad)
        for values in (xyz_m, heading_rad, velocity_mps, size_lwh_m):
            values[~valid] = 0
    types = [
        _TYPES.get(text_of(each.get("type")), AgentType.OTHER) for each in tracks.values()
    ]
    with np.errstate(over="ignore"):
        return WorldTracks(
            id=np.array(list(track_ids(tracks).values()), np.int32),
            type=np.array(types, np.int32) + 1,
            xyz_m=xyz_m,
            heading_rad=heading_rad.astype(np.float32),
            velocity_mps=velocity_mps.astype(np.float32),
            size_lwh_m=size_lwh_m.astype(np.float32),
            valid=valid,
        )


def _columns(
    state: Part, name: str, track: str, num_steps: int, width: int
) -> Float64[np.ndarray, "step width"]:
    found = _states(state, name, track, num_steps)
    if found.shape[1] < width:
        raise RecordError(f"track {track[:40]} has {name} of shape {found.shape}")
    return found[:, :width]


def _states(
    state: Part, name: str, track: str, num_steps: int
) -> Float64[np.ndarray, "step width"]:
    """Values of all steps; one value stands for all of them."""
    if name not in state:
        raise RecordError(f"track {track[:40]} has no {name}")
    if _is_number(state[name]):
        return np.full((num_steps, 1), float(state[name]))
    found = array(state[name])
    if found.ndim == 1:
        found = found[:, None]
    if found.ndim != 2 or len(found) != num_steps or found.shape[1] < 1:
        raise RecordError(
            f"track {track[:40]} has {name} of shape {found.shape} for {num_steps} steps"
        )
    return found


def _wrapped(heading_rad: Float64[np.ndarray, "agent step"]) -> np.ndarray:
    """Bring headings that a converter unwrapped back to [-pi, pi); others stay as are."""
    beyond = (heading_rad < -np.pi) | (heading_rad >= np.pi)
    with np.errstate(invalid="ignore"):
        return np.where(beyond, wrap_angle(heading_rad), heading_rad)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float)


def _lengthwise(size_lwh_m: Float64[np.ndarray, "step 3"]) -> Float64[np.ndarray, "step 3"]:
    """Exchange length and width where a box is wider than long."""
    wide = size_lwh_m[:, 1] > size_lwh_m[:, 0]
    return np.where(wide[:, None], size_lwh_m[:, [1, 0, 2]], size_lwh_m)
