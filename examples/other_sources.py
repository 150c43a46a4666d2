"""Write small files of the layouts of Argoverse 2 and ScenarioNet, from made logs.

``python examples/other_sources.py made`` writes folders that `infgen` reads as it reads the
real data sets. The street of `street.py` stands for a log.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from jaxtyping import Float64
from street import LANES_Y_M, street

from infgen.exports.scenarionet_scene import write_scene
from infgen.scene import AgentType, Scene

SPLITS = {"train": "training", "val": "validation"}
MOTION_TYPES = {
    AgentType.VEHICLE: "vehicle",
    AgentType.PEDESTRIAN: "pedestrian",
    AgentType.CYCLIST: "cyclist",
    AgentType.OTHER: "static",
}
CATEGORIES = {
    AgentType.VEHICLE: "REGULAR_VEHICLE",
    AgentType.PEDESTRIAN: "PEDESTRIAN",
    AgentType.CYCLIST: "BICYCLIST",
    AgentType.OTHER: "BOLLARD",
}
EGO_CENTRE_M = np.array([1.422, 0.0, 0.25])
"""Of the recording car, ahead of the middle of its rear axle."""
START_NS = 315_970_000_000_000_000
SWEEP_NS = 100_000_000
EDGES_X_M, EDGES_Y_M = (-80.0, 250.0, 580.0), (-2.0, 5.5)
"""Of the two drivable areas, which touch; lanes go on beyond them."""


def write_motion(folder: Path, scene: Scene) -> None:
    """Write one log as a motion forecasting scenario: a Parquet table and a map."""
    folder.mkdir(parents=True, exist_ok=True)
    tracks = scene.tracks
    row, step = np.nonzero(tracks.valid)
    world_m = tracks.xyz_m[row, step].astype(np.float64) + scene.origin_xyz_m
    names = [
        "AV" if at == scene.ego else str(track)
        for at, track in enumerate(tracks.id.tolist())
    ]
    wanted = np.isin(np.arange(tracks.num_agents), scene.predict_row)
    table = pl.DataFrame(
        {
            "observed": step <= scene.now,
            "track_id": [names[at] for at in row],
            "object_type": [MOTION_TYPES[AgentType(tracks.agent_type[at])] for at in row],
            "object_category": np.where(wanted, 3, 1)[row],
            "timestep": step,
            "position_x": world_m[:, 0],
            "position_y": world_m[:, 1],
            "heading": tracks.heading_rad[row, step].astype(np.float64),
            "velocity_x": tracks.velocity_mps[row, step, 0].astype(np.float64),
            "velocity_y": tracks.velocity_mps[row, step, 1].astype(np.float64),
            "scenario_id": [folder.name] * len(row),
        }
    )
    table.write_parquet(folder / f"scenario_{folder.name}.parquet")
    archive = street_map(scene.origin_xyz_m)
    (folder / f"log_map_archive_{folder.name}.json").write_text(json.dumps(archive))


def write_sensor(folder: Path, scene: Scene) -> None:
    """Write one log as a sensor log: boxes in the ego frame, poses and a map."""
    (folder / "map").mkdir(parents=True, exist_ok=True)
    tracks, ego = scene.tracks, scene.ego
    time_ns = START_NS + SWEEP_NS * np.arange(tracks.num_steps)
    half_rad = tracks.heading_rad.astype(np.float64) / 2
    world_m = tracks.xyz_m.astype(np.float64) + scene.origin_xyz_m
    axle_m = world_m[ego] - _turned(
        np.broadcast_to(EGO_CENTRE_M, world_m[ego].shape), 2 * half_rad[ego]
    )
    zero = np.zeros(tracks.num_steps)
    pl.DataFrame(
        {
            "timestamp_ns": time_ns,
            "qw": np.cos(half_rad[ego]),
            "qx": zero,
            "qy": zero,
            "qz": np.sin(half_rad[ego]),
            "tx_m": axle_m[:, 0],
            "ty_m": axle_m[:, 1],
            "tz_m": axle_m[:, 2],
        }
    ).write_ipc(folder / "city_SE3_egovehicle.feather")
    others = np.arange(tracks.num_agents) != ego
    row, step = np.nonzero(tracks.valid & others[:, None])
    local_m = _turned(world_m[row, step] - axle_m[step], -2 * half_rad[ego, step])
    turn_rad = half_rad[row, step] - half_rad[ego, step]
    size_m = tracks.size_lwh_m[row, step].astype(np.float64)
    pl.DataFrame(
        {
            "timestamp_ns": time_ns[step],
            "track_uuid": [f"track-{tracks.id[at]}" for at in row],
            "category": [CATEGORIES[AgentType(tracks.agent_type[at])] for at in row],
            **dict(zip(("length_m", "width_m", "height_m"), size_m.T, strict=True)),
            "qw": np.cos(turn_rad),
            "qx": np.zeros(len(row)),
            "qy": np.zeros(len(row)),
            "qz": np.sin(turn_rad),
            **dict(zip(("tx_m", "ty_m", "tz_m"), local_m.T, strict=True)),
            "num_interior_pts": np.full(len(row), 9),
        }
    ).write_ipc(folder / "annotations.feather")
    archive = street_map(scene.origin_xyz_m)
    path = folder / "map" / f"log_map_archive_{folder.name}____PIT_city_1.json"
    path.write_text(json.dumps(archive))


def street_map(origin_xyz_m: Float64[np.ndarray, "3"]) -> dict[str, Any]:
    """Make a map archive: two lanes along +x, two drivable areas, a crosswalk."""
    low_y_m, high_y_m = EDGES_Y_M
    first_x_m, middle_x_m, last_x_m = EDGES_X_M
    middle_y_m = sum(LANES_Y_M) / 2

    def points(*places_m: tuple[float, float]) -> list[dict[str, float]]:
        return [
            {
                "x": x_m + float(origin_xyz_m[0]),
                "y": y_m + float(origin_xyz_m[1]),
                "z": float(origin_xyz_m[2]),
            }
            for x_m, y_m in places_m
        ]

    def along(y_m: float) -> list[dict[str, float]]:
        return points((first_x_m, y_m), (middle_x_m, y_m), (last_x_m, y_m))

    lane = {"is_intersection": False, "successors": [], "predecessors": []}
    return {
        "lane_segments": {
            "11": {
                **lane,
                "id": 11,
                "lane_type": "VEHICLE",
                "left_lane_boundary": along(middle_y_m),
                "left_lane_mark_type": "DASHED_WHITE",
                "left_neighbor_id": 12,
                "right_lane_boundary": along(2 * LANES_Y_M[0] - middle_y_m),
                "right_lane_mark_type": "NONE",
                "right_neighbor_id": None,
                "successors": [13],
            },
            "12": {
                **lane,
                "id": 12,
                "lane_type": "BIKE",
                "left_lane_boundary": along(2 * LANES_Y_M[1] - middle_y_m),
                "left_lane_mark_type": "SOLID_YELLOW",
                "left_neighbor_id": None,
                "right_lane_boundary": along(middle_y_m),
                "right_lane_mark_type": "DASHED_WHITE",
                "right_neighbor_id": 11,
            },
        },
        "pedestrian_crossings": {
            "21": {
                "id": 21,
                "edge1": points((40.0, low_y_m), (40.0, high_y_m)),
                "edge2": points((44.0, low_y_m), (44.0, high_y_m)),
            }
        },
        "drivable_areas": {
            str(31 + at): {
                "id": 31 + at,
                "area_boundary": points(
                    (begin, low_y_m), (end, low_y_m), (end, high_y_m), (begin, high_y_m)
                ),
            }
            for at, (begin, end) in enumerate(
                ((first_x_m, middle_x_m), (middle_x_m, last_x_m))
            )
        },
    }


def write_all(out: Path, speeds_mps: Sequence[float] = (8.0, 7.0, 9.0, 0.0)) -> None:
    """Write two scenes of each kind and split."""
    for folder, split in SPLITS.items():
        for at in range(2):
            faster = tuple(speed + at for speed in speeds_mps)
            motion = replace(street(faster, steps=110), now=49)
            write_motion(out / "av2/motion_forecasting" / folder / f"{split}-{at}", motion)
            log = street(faster, steps=151)
            write_sensor(out / "av2/sensor" / folder / f"log-{split}-{at}", log)
            (out / "scenarionet").mkdir(exist_ok=True)
            path = out / "scenarionet" / f"sd_made_{split}-{at}.pkl"
            write_scene(path, replace(log, scenario_id=f"net-{split}-{at}"), split)


def _turned(
    xyz_m: Float64[np.ndarray, "row 3"], angle_rad: Float64[np.ndarray, " row"]
) -> Float64[np.ndarray, "row 3"]:
    """Turn points about the vertical axis, counter-clockwise."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x_m, y_m, z_m = xyz_m.T
    return np.stack([cos * x_m - sin * y_m, sin * x_m + cos * y_m, z_m], axis=1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    write_all(parser.parse_args().out)
