"""Sensor logs of Argoverse 2: boxes per lidar sweep, and the poses of the car.

Boxes are given in the ego frame at the time of their sweep. They are brought to the city
frame first, and then to the 10 Hz clock: sweeps come every 96 to 104 ms.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.clock import CLOCK
from infgen.geometry import wrap_angle
from infgen.scene import AgentType
from infgen.sources.argoverse2.categories import (
    EGO_CENTRE_M,
    EGO_SIZE_LWH_M,
    SENSOR_TYPES,
)
from infgen.sources.argoverse2.poses import Poses, check_rotations, rotations
from infgen.sources.argoverse2.roads import track_ids
from infgen.sources.argoverse2.tables import FLOAT, INTEGER, TEXT, read_feather
from infgen.sources.tfrecord import RecordError
from infgen.sources.womd import MAX_STEPS
from infgen.sources.womd_tracks import WorldTracks

NOW = 10
EGO = "ego"
MAX_GAP_NS = 250_000_000
"""Longest time between two boxes of a track that is bridged: one missed sweep."""
MAX_STATES = 2_000_000
STEP_NS = round(CLOCK.step_s * 1e9)

_QUATERNION = ("qw", "qx", "qy", "qz")
_TRANSLATION = ("tx_m", "ty_m", "tz_m")
_SIZES = ("length_m", "width_m", "height_m")
_POSES = {"timestamp_ns": INTEGER, **dict.fromkeys(_QUATERNION + _TRANSLATION, FLOAT)}
_BOXES = {
    **_POSES,
    "track_uuid": TEXT,
    "category": TEXT,
    **dict.fromkeys(_SIZES, FLOAT),
}


def read_sensor(annotations: bytes, poses: bytes) -> WorldTracks:
    """Read all tracks of a log, city frame; the recording car is the first.

    Raises:
        RecordError: if a table is none, or two boxes are of one track and sweep.
    """
    boxes, car = read_feather(annotations, _BOXES), _read_poses(poses)
    time_ns = boxes["timestamp_ns"]
    steps_ns = _clock(time_ns)
    if not (
        car.time_ns[0] - STEP_NS <= time_ns.min()
        and time_ns.max() <= car.time_ns[-1] + STEP_NS
    ):
        raise RecordError("boxes and poses of the car are of different times")
    names, tracks = _by_track(boxes["track_uuid"])
    if (len(names) + 1) * len(steps_ns) > MAX_STATES:
        raise RecordError(f"log has {len(names)} tracks of {len(steps_ns)} steps")
    pose = _box_poses(boxes, car.at(time_ns))  # [box, 4]
    if not np.isfinite(pose).all():
        raise RecordError("a box has a pose that is not finite")
    shape = (len(names) + 1, len(steps_ns))
    states, valid = np.zeros((*shape, 4)), np.zeros(shape, bool)
    size_lwh_m = np.zeros((shape[0], 3))
    states[0], valid[0], size_lwh_m[0] = _ego(car.at(steps_ns)), True, EGO_SIZE_LWH_M
    types = [AgentType.VEHICLE]
    for row, rows in enumerate(tracks, start=1):
        rows = rows[np.argsort(time_ns[rows], kind="stable")]
        if (np.diff(time_ns[rows]) == 0).any():
            raise RecordError(f"track {names[row - 1]} has two boxes in one sweep")
        states[row], valid[row] = _to_clock(time_ns[rows], pose[rows], steps_ns)
        size_lwh_m[row] = [np.median(boxes[name][rows]) for name in _SIZES]
        types.append(SENSOR_TYPES.get(boxes["category"][rows[0]], AgentType.OTHER))
    ids = track_ids([EGO, *names])
    return WorldTracks(
        id=np.array(list(ids.values()), np.int32),
        type=np.array(types, np.int32) + 1,
        xyz_m=states[..., :3],
        heading_rad=states[..., 3].astype(np.float32),
        velocity_mps=_velocity(states[..., :2], valid).astype(np.float32),
        size_lwh_m=np.where(valid[..., None], size_lwh_m[:, None], 0).astype(np.float32),
        valid=valid,
    )


def _read_poses(data: bytes) -> Poses:
    table = read_feather(data, _POSES)
    time_ns, first = np.unique(table["timestamp_ns"], return_index=True)
    quaternion = np.stack([table[name][first] for name in _QUATERNION], axis=1)
    check_rotations(quaternion, "pose of the car")
    return Poses(time_ns, quaternion, np.stack([table[n][first] for n in _TRANSLATION], 1))


def _clock(time_ns: Int64[np.ndarray, " box"]) -> Int64[np.ndarray, " step"]:
    """Times of the 10 Hz steps, from the first sweep to the last."""
    first, last = int(time_ns.min()), int(time_ns.max())
    num_steps = round((last - first) / STEP_NS) + 1
    if num_steps > MAX_STEPS:
        raise RecordError(f"log of {num_steps} steps; expected at most {MAX_STEPS}")
    return first + STEP_NS * np.arange(num_steps, dtype=np.int64)


def _by_track(names: np.ndarray) -> tuple[list[str], list[Int64[np.ndarray, " _"]]]:
    """Tracks in the order of their first box, and the rows of each."""
    places: dict[str, int] = {}
    track = np.array([places.setdefault(name, len(places)) for name in names], np.int64)
    order = np.argsort(track, kind="stable")
    ends = np.searchsorted(track[order], np.arange(1, len(places)))
    return list(places), np.split(order, ends)


def _box_poses(boxes: dict[str, np.ndarray], car: Poses) -> Float64[np.ndarray, "box 4"]:
    """Centres and headings of boxes in the city frame, from the car's pose at each."""
    quaternion = np.stack([boxes[name] for name in _QUATERNION], axis=1)
    check_rotations(quaternion, "box")
    centre_m = np.stack([boxes[name] for name in _TRANSLATION], axis=1)
    heading_rad = car.headings(rotations(quaternion)[:, :, 0])
    return np.column_stack([car.to_city(centre_m), heading_rad])


def _ego(car: Poses) -> Float64[np.ndarray, "step 4"]:
    """Centre and heading of the car's own box."""
    places = np.broadcast_to(np.array(EGO_CENTRE_M), car.xyz_m.shape)
    ahead = np.broadcast_to(np.array([1.0, 0.0, 0.0]), car.xyz_m.shape)
    return np.column_stack([car.to_city(places), car.headings(ahead)])


def _to_clock(
    time_ns: Int64[np.ndarray, " box"],
    pose: Float64[np.ndarray, "box 4"],
    steps_ns: Int64[np.ndarray, " step"],
) -> tuple[Float64[np.ndarray, "step 4"], Bool[np.ndarray, " step"]]:
    """Interpolate a track to the steps; half a step beyond its ends it goes straight on.

    A step between two boxes that are farther apart than one missed sweep is not valid.
    """
    pose = np.column_stack([pose[:, :3], np.unwrap(pose[:, 3])])
    slack_ns = STEP_NS // 2
    near = (steps_ns >= time_ns[0] - slack_ns) & (steps_ns <= time_ns[-1] + slack_ns)
    if len(time_ns) == 1:
        return np.where(near[:, None], pose, 0.0), near
    after = np.clip(np.searchsorted(time_ns, steps_ns), 1, len(time_ns) - 1)
    span_ns = time_ns[after] - time_ns[after - 1]
    share = ((steps_ns - time_ns[after - 1]) / span_ns)[:, None]
    found = pose[after - 1] * (1 - share) + pose[after] * share
    found[:, 3] = wrap_angle(found[:, 3])
    at_box = np.minimum(
        np.abs(steps_ns - time_ns[after - 1]), np.abs(steps_ns - time_ns[after])
    )
    valid = near & ((span_ns <= MAX_GAP_NS) | (at_box <= slack_ns))
    return np.where(valid[:, None], found, 0.0), valid


def _velocity(
    xy_m: Float64[np.ndarray, "agent step 2"], valid: Bool[np.ndarray, "agent step"]
) -> Float64[np.ndarray, "agent step 2"]:
    """Central differences of positions; one-sided at the ends of what is seen."""
    before, after = _shifted(xy_m, valid, 1), _shifted(xy_m, valid, -1)
    span_s = CLOCK.step_s * (before[1].astype(float) + after[1])[..., None]
    moved_m = after[0] - before[0]
    known = valid[..., None] & (span_s > 0)
    return np.where(known, moved_m / np.where(span_s > 0, span_s, 1.0), 0.0)


def _shifted(xy_m: np.ndarray, valid: np.ndarray, by: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions one step before (1) or after (-1), own ones where there is none."""
    there = np.zeros_like(valid)
    other = xy_m.copy()
    to, of = (
        (slice(1, None), slice(None, -1)) if by > 0 else (slice(None, -1), slice(1, None))
    )
    there[:, to] = valid[:, of] & valid[:, to]
    other[:, to] = np.where(there[:, to, None], xy_m[:, of], xy_m[:, to])
    return other, there
