"""The official values, beside the checkout (never in it)."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from infgen.metrics.likelihood import Bernoulli, Histogram
from infgen.metrics.wosac.logged import LoggedScene
from infgen.metrics.wosac.rollouts import Rollouts
from infgen.metrics.wosac.versions import INTERACTIVE, KINEMATIC, MAP_BASED, Rule, Version

GOLDEN = Path(__file__).parents[3] / "shared" / "golden" / "wosac"
SETS = sorted(
    f"{p.parent.parent.name}/{p.parent.name}" for p in GOLDEN.glob("*/*/metrics.json")
)
needs_goldens = pytest.mark.skipif(
    not SETS, reason=f"the official values are not at {GOLDEN}"
)
BUCKETS = {
    "linear": KINEMATIC,
    "angular": KINEMATIC,
    "collision": INTERACTIVE,
    "time": INTERACTIVE,
    "distance_to_nearest": INTERACTIVE,
}


@cache
def golden_log(scenario: str) -> LoggedScene:
    with np.load(GOLDEN / scenario / "scenario.npz") as file:
        raw = dict(file)
    f32 = {
        name: raw[f"track_{name}"].astype(np.float32) for name in ("x", "y", "z", "heading")
    }
    size = [raw[f"track_{name}"][:, 10] for name in ("length", "width", "height")]
    streets = np.flatnonzero((raw["lane_type"] == 2) & (raw["lane_len"] >= 2))
    lane_starts = np.concatenate([[0], np.cumsum(raw["lane_len"])])
    lanes = [raw["lane_xyz"][lane_starts[i] : lane_starts[i + 1]] for i in streets]
    step, lane, state, x, y, _ = raw["tl_t_lane_state_xyz"].T
    lane_id, signal = np.unique(lane.astype(np.int64), return_inverse=True)
    states = np.zeros((len(lane_id), 91), dtype=np.int8)
    stops = np.zeros((len(lane_id), 91, 2), dtype=np.float32)
    states[signal, step.astype(int)] = state
    stops[signal, step.astype(int)] = np.stack([x, y], axis=1)
    return LoggedScene(
        scenario_id=scenario,
        id=raw["track_id"].astype(np.int32),
        agent_type=(raw["track_type"] - 1).astype(np.int8),
        x_m=f32["x"],
        y_m=f32["y"],
        z_m=f32["z"],
        heading_rad=f32["heading"],
        size_lwh_m=np.stack(size, axis=1).astype(np.float32),
        valid=raw["track_valid"],
        ego=int(raw["sdc_track_index"]),
        predict_row=raw["tracks_to_predict"].astype(np.int32),
        edge_m=raw["road_edge_xyz"].astype(np.float32),
        edge_offsets=np.concatenate([[0], np.cumsum(raw["road_edge_len"])]),
        lane_id=raw["lane_id"][streets],
        lane_m=np.concatenate(lanes).astype(np.float32),
        lane_offsets=np.cumsum([0, *map(len, lanes)]).astype(np.int64),
        signal_lane_id=lane_id,
        signal_state=states,
        signal_stop_m=stops,
    )


@cache
def golden_rollouts(name: str) -> Rollouts:
    raw = golden_arrays(name, "rollouts")
    return Rollouts(
        scenario_id=name.split("/")[0],
        object_id=raw["object_id"],
        x_m=raw["x"],
        y_m=raw["y"],
        z_m=raw["z"],
        heading_rad=raw["heading"],
    )


@cache
def golden_arrays(name: str, file: str) -> dict[str, np.ndarray]:
    with np.load(GOLDEN / name / f"{file}.npz") as arrays:
        return dict(arrays)


@cache
def golden_metrics(name: str) -> dict[str, dict[str, Any]]:
    return json.loads((GOLDEN / name / "metrics.json").read_text())["metrics"]


@cache
def golden_configurations() -> dict[str, dict[str, Any]]:
    return json.loads((GOLDEN / "configs_and_bin_edges.json").read_text())


def golden_version(name: str) -> Version:
    """Build any of the published configurations, the two test ones among them."""
    return Version(
        name,
        tuple(
            Rule(feature, _bucket(feature), values["weight"], _estimator(values))
            for feature, values in golden_configurations()[name].items()
            if not feature.startswith("_")
        ),
    )


def _bucket(feature: str) -> str:
    return next((b for start, b in BUCKETS.items() if feature.startswith(start)), MAP_BASED)


def _estimator(values: dict[str, Any]) -> Histogram | Bernoulli:
    if values["estimator"] != "histogram":
        # The 2023 challenge had no red lights; its official values were made with weight 0.
        return Bernoulli(values.get("pseudocount", 0.001), values["aggregate_objects"])
    return Histogram(
        values["min_val"],
        values["max_val"],
        values["num_bins"],
        values["pseudocount"],
        values["independent_timesteps"],
        values["aggregate_objects"],
    )
