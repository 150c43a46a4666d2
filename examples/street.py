"""A street with cars, and a network that has learned nothing yet: to try things out."""

import numpy as np
import torch

from infgen.clock import CLOCK
from infgen.config import ModelSettings, TokenSettings, VocabSettings
from infgen.model.network import Network
from infgen.scene import AgentType, FeatureType, LaneType, RoadMap, Scene, Signals, Tracks
from infgen.tokens.clustering.made_motion_samples import make_fan
from infgen.tokens.clustering.physical_limits import motion_limits
from infgen.tokens.vocabulary import BOX_LW_M, MapVocabulary, MotionVocabulary

SMALL = ModelSettings(width=32, heads=4, map_blocks=1, motion_blocks=1, scene_blocks=1)
STREET_M = 600.0
LANES_Y_M = (0.0, 3.5)
NOW = 10


def street(
    speeds_mps: tuple[float, ...] = (8.0, 7.0, 9.0, 0.0), steps: int = NOW + 1
) -> Scene:
    """Lay out a street of two lanes along +x.

    Args:
        speeds_mps: Of the cars. The first is the ego, at the origin now; the next drive
            30 m apart in front of it, every other one in the left lane.
        steps: Length of the log; without more, the history alone.
    """
    cars = len(speeds_mps)
    number = np.arange(cars)
    seconds = CLOCK.step_s * (np.arange(steps) - NOW)
    xyz_m = np.zeros((cars, steps, 3), dtype=np.float32)
    xyz_m[..., 0] = 30 * number[:, None] + np.outer(speeds_mps, seconds)
    xyz_m[..., 1] = np.array(LANES_Y_M)[number % 2][:, None]
    xyz_m[..., 2] = 0.8
    velocity_mps = np.zeros((cars, steps, 2), dtype=np.float32)
    velocity_mps[..., 0] = np.array(speeds_mps)[:, None]
    size_lwh_m = np.array([4.8, 2.0, 1.6], dtype=np.float32)
    return Scene(
        scenario_id="street",
        origin_xyz_m=np.zeros(3),
        timestamps_s=seconds - seconds[0],
        now=NOW,
        ego=0,
        predict_row=np.zeros(1, dtype=np.int32),
        predict_difficulty=np.zeros(1, dtype=np.int8),
        interest_id=np.empty(0, dtype=np.int32),
        tracks=Tracks(
            id=number.astype(np.int32),
            agent_type=np.full(cars, AgentType.VEHICLE, dtype=np.int8),
            xyz_m=xyz_m,
            heading_rad=np.zeros((cars, steps), dtype=np.float32),
            velocity_mps=velocity_mps,
            size_lwh_m=np.broadcast_to(size_lwh_m, (cars, steps, 3)),
            valid=np.ones((cars, steps), dtype=bool),
        ),
        road_map=_lanes(),
        signals=Signals(
            step=np.empty(0, dtype=np.int16),
            lane_id=np.empty(0, dtype=np.int64),
            state=np.empty(0, dtype=np.int8),
            stop_xyz_m=np.empty((0, 3), dtype=np.float32),
        ),
    )


def _lanes() -> RoadMap:
    """Two lanes and nothing else."""
    x_m = np.arange(-100.0, STREET_M)
    lines_m = [np.column_stack([x_m, 0 * x_m + y_m, 0 * x_m]) for y_m in LANES_Y_M]
    lanes, none = len(lines_m), np.empty(0, dtype=np.int64)
    few = none.astype(np.int8)
    return RoadMap(
        feature_id=np.arange(1, lanes + 1),
        feature_type=np.full(lanes, FeatureType.LANE, dtype=np.int8),
        feature_subtype=np.full(lanes, LaneType.SURFACE_STREET, dtype=np.int8),
        speed_limit_mph=np.full(lanes, 30, dtype=np.float32),
        interpolating=np.zeros(lanes, dtype=bool),
        point_offsets=np.arange(lanes + 1) * len(x_m),
        xyz_m=np.concatenate(lines_m).astype(np.float32),
        link_lane_id=none,
        link_type=few,
        link_other_id=none,
        neighbour_lane_id=none,
        neighbour_side=few,
        neighbour_other_id=none,
        neighbour_span=np.empty((0, 4), dtype=np.int32),
        boundary_lane_id=none,
        boundary_side=few,
        boundary_feature_id=none,
        boundary_type=few,
        boundary_span=np.empty((0, 2), dtype=np.int32),
        boundary_neighbour=np.empty(0, dtype=np.int32),
        sign_id=none,
        sign_lane_id=none,
    )


def fresh_network(seed: int = 0) -> Network:
    """Make a small network that has learned nothing, with moves and roads made by rule."""
    limits = motion_limits(VocabSettings())
    fans = [make_fan(kind, limits, spacing_m=0.3) for kind in range(3)]
    moves = min(len(paths) for paths in fans)
    still = np.zeros((1, CLOCK.steps_per_token + 1, 3), dtype=np.float32)
    path = np.stack([np.concatenate([still, paths[: moves - 1]]) for paths in fans])
    bend_rad = np.linspace(-0.08, 0.08, 33)[:, None] * np.arange(10)
    steps_m = 0.5 * np.stack([np.cos(bend_rad), np.sin(bend_rad)], axis=-1)
    curve_m = np.pad(steps_m.cumsum(axis=1), ((0, 0), (1, 0), (0, 0))).astype(np.float32)
    torch.manual_seed(seed)
    return Network(
        SMALL,
        MotionVocabulary(BOX_LW_M, path, np.zeros(path.shape[:2], dtype=bool)),
        MapVocabulary(curve_m, np.zeros(len(curve_m), dtype=bool)),
        TokenSettings(),
    )
