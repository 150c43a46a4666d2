"""Motion forecasting scenarios of Argoverse 2: a Parquet table of tracks and a map.

Tracks have positions in the plane, and no boxes: heights are those of the map, boxes
nominal ones (``categories``).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from infgen.scene import AgentType
from infgen.sources.argoverse2.categories import (
    MOTION_SIZES_LWH_M,
    MOTION_TYPES,
    OTHER_SIZE_LWH_M,
)
from infgen.sources.argoverse2.roads import Ground, track_ids
from infgen.sources.argoverse2.tables import FLOAT, INTEGER, TEXT, read_parquet
from infgen.sources.tfrecord import RecordError
from infgen.sources.womd import MAX_STEPS
from infgen.sources.womd_tracks import WorldTracks

EGO = "AV"
NOW = 49
"""Last of the 50 observed steps."""
SCORED, FOCAL = 2, 3
"""``object_category`` of tracks to predict."""
MAX_STATES = 2_000_000
_COLUMNS = {
    "track_id": TEXT,
    "object_type": TEXT,
    "object_category": INTEGER,
    "timestep": INTEGER,
    "position_x": FLOAT,
    "position_y": FLOAT,
    "heading": FLOAT,
    "velocity_x": FLOAT,
    "velocity_y": FLOAT,
    "scenario_id": TEXT,
}


class MotionLog(NamedTuple):
    """What the table of a scenario says.

    Attributes:
        scenario_id: Its id.
        tracks: All tracks, city frame.
        ego: Row of the recording car.
        predict_row: Rows of the focal and the scored tracks.
        focal_id: Ids of the focal tracks.
    """

    scenario_id: str
    tracks: WorldTracks
    ego: int
    predict_row: Int64[np.ndarray, " predict"]
    focal_id: Int64[np.ndarray, " focal"]


def read_motion(data: bytes, ground: Ground) -> MotionLog:
    """Read a scenario's tracks.

    Raises:
        RecordError: if it is no such table, two states are of one track and step, or there
            is no ego.
    """
    table = read_parquet(data, _COLUMNS)
    step = table["timestep"]
    if step.min() < 0 or step.max() >= MAX_STEPS:
        raise RecordError(f"timesteps run from {step.min()} to {step.max()}")
    names, first, row = _in_order(table["track_id"])
    if EGO not in names:
        raise RecordError(f"scenario has no track {EGO!r}: no recording car")
    shape = (len(names), int(step.max()) + 1)
    if shape[0] * shape[1] > MAX_STATES:
        raise RecordError(f"scenario has {shape[0]} tracks of {shape[1]} steps")
    valid = np.zeros(shape, bool)
    valid[row, step] = True
    if valid.sum() < len(step):
        raise RecordError("a track has two states at one step")
    kinds = [str(kind) for kind in table["object_type"][first]]
    sizes = np.array([MOTION_SIZES_LWH_M.get(kind, OTHER_SIZE_LWH_M) for kind in kinds])
    xy_m = np.stack([table["position_x"], table["position_y"]], axis=1)
    xyz_m = np.zeros((*shape, 3))
    xyz_m[row, step] = np.column_stack([xy_m, ground.height_m(xy_m) + sizes[row, 2] / 2])
    category, ids = table["object_category"][first], track_ids(names)
    number = np.array([ids[name] for name in names], np.int64)
    types = [MOTION_TYPES.get(kind, AgentType.OTHER) for kind in kinds]
    tracks = WorldTracks(
        id=number.astype(np.int32),
        type=np.array(types, np.int32) + 1,
        xyz_m=xyz_m,
        heading_rad=_spread(table["heading"], row, step, shape),
        velocity_mps=_spread(
            np.stack([table["velocity_x"], table["velocity_y"]], axis=1), row, step, shape
        ),
        size_lwh_m=np.where(valid[..., None], sizes[:, None], 0).astype(np.float32),
        valid=valid,
    )
    wanted = np.flatnonzero(np.isin(category, (SCORED, FOCAL)))
    return MotionLog(
        scenario_id=str(table["scenario_id"][0]),
        tracks=tracks,
        ego=names.index(EGO),
        predict_row=wanted[np.argsort(-category[wanted], kind="stable")],
        focal_id=number[category == FOCAL],
    )


def _in_order(
    names: np.ndarray,
) -> tuple[list[str], Int64[np.ndarray, " track"], Int64[np.ndarray, " row"]]:
    """Order tracks by their first row: names, that row, and the track of each row."""
    places: dict[str, int] = {}
    row = np.array([places.setdefault(name, len(places)) for name in names], np.int64)
    _, first = np.unique(row, return_index=True)
    return list(places), first, row


def _spread(
    values: np.ndarray, row: np.ndarray, step: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Place one value per state in a table of tracks and steps; others are zero."""
    found = np.zeros((*shape, *values.shape[1:]), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        found[row, step] = values
    return found
