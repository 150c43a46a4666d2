"""A street with cars, built of arrays: what a log of your own must hold.

Simulated with the weights of the package, and written as a page to watch::

    python examples/street.py
"""

import numpy as np

import infgen
from infgen.clock import CLOCK
from infgen.scene import AgentType, FeatureType, LaneType, RoadMap, Scene, Signals, Tracks

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


def main() -> None:
    """Simulate the street, and say where the page is."""
    rollouts = infgen.load("towns").rollout(street(), seconds=10, count=2)
    print(rollouts.view(log=False))


if __name__ == "__main__":
    main()
