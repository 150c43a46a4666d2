"""Statistics of two sets of driving logs side by side: are towns like real scenes?

By default the towns that come with the package beside the shared real records::

    python benchmarks/towns_statistics.py [--towns 'DIR/*'] [--real 'DIR/*'] [--scenes N]

Prints a Markdown table; the last line is one JSON object of both columns.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from glob import glob
from itertools import islice

import numpy as np
from records import BUILT_IN, SHARED

from infgen.clock import CLOCK
from infgen.config import TokenSettings
from infgen.metrics.kinematics import measure_kinematics, speed_valid
from infgen.metrics.placement import count_per_token
from infgen.metrics.road import road_edge_m
from infgen.metrics.traffic import Traffic, from_log
from infgen.scene import AgentType, FeatureType, LaneType, Scene
from infgen.sources.womd import iter_scenes
from infgen.spatial.road_edges import scene_road_edges
from infgen.tokens.map import cut_map_tokens
from infgen.tokens.validity_patterns import encode_patterns

NEAR_M = 75.0
STILL_M = 1.0
"""Who comes no farther than this from where it was first seen stands."""
WHOLE_PATTERN = 31
QUANTILES = (10, 50, 90)

TokenStep = dict[str, float]
"""One set's statistics by name."""
Values = dict[str, np.ndarray]
"""One scene's values by name; of a set they are pooled."""


def measure(scene: Scene) -> tuple[TokenStep, Values]:
    """Measure one scene: its counts, and values to be pooled over scenes."""
    traffic = from_log(scene, TokenSettings())
    counts = _count_agents(traffic) | _count_events(traffic) | _count_map(scene)
    return counts, _motion_of(scene, traffic) | _sight_of(traffic)


def _count_agents(traffic: Traffic) -> TokenStep:
    agent_type, valid = traffic.motion.agent_type, traffic.motion.valid[0]
    near = valid & (_apart_m(traffic) < NEAR_M)
    others = np.arange(len(agent_type)) != traffic.ego
    counts: TokenStep = {"agents ever": len(agent_type)}
    for each in (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST):
        counts[f"{each.name.lower()}s now"] = float(
            (traffic.there_now & (agent_type == each)).sum()
        )
    counts["agents within 75 m, mean over steps"] = float(near[others].sum(axis=0).mean())
    return counts


def _count_events(traffic: Traffic) -> TokenStep:
    """Entries and exits per half second."""
    events, num_steps = traffic.events, traffic.motion.valid.shape[2]
    tokens = CLOCK.num_tokens(num_steps) - CLOCK.token_ending_at(traffic.now) - 1
    counts: TokenStep = {}
    for words, radius_m in (("within 75 m", NEAR_M), ("anywhere", np.inf)):
        entries = count_per_token(
            events.entry_token, events.entry_distance_m, radius_m, tokens
        )
        exits = count_per_token(events.exit_token, events.exit_distance_m, radius_m, tokens)
        # Nobody is seen to enter or leave in the last token steps.
        counts[f"entries per half second {words}"] = float(entries[:-2].mean())
        counts[f"exits per half second {words}"] = float(exits[:-2].mean())
    return counts


def _count_map(scene: Scene) -> TokenStep:
    road_map, kinds = scene.road_map, scene.road_map.feature_type
    lanes = kinds == FeatureType.LANE
    bike = lanes & (road_map.feature_subtype == LaneType.BIKE_LANE)
    from_ego_m = road_map.xyz_m[:, :2] - scene.tracks.xyz_m[scene.ego, scene.now, :2]
    return {
        "map tokens": float(len(cut_map_tokens(road_map).polyline)),
        "map points": float(len(road_map.xyz_m)),
        "map points within 75 m": float((np.hypot(*from_ego_m.T) < NEAR_M).sum()),
        "lanes": float(lanes.sum()),
        "bicycle lanes": float(bike.sum()),
        "road lines": float((kinds == FeatureType.ROAD_LINE).sum()),
        "road edges": float((kinds == FeatureType.ROAD_EDGE).sum()),
        "crosswalks": float((kinds == FeatureType.CROSSWALK).sum()),
        "stop signs": float((kinds == FeatureType.STOP_SIGN).sum()),
        "lanes with signals": float(len(np.unique(scene.signals.lane_id))),
    }


def _apart_m(traffic: Traffic) -> np.ndarray:
    x_m, y_m = traffic.motion.x_m[0], traffic.motion.y_m[0]
    return np.hypot(x_m - x_m[traffic.ego], y_m - y_m[traffic.ego])


def _motion_of(scene: Scene, traffic: Traffic) -> Values:
    motion, valid = traffic.motion, traffic.motion.valid[0]
    found = measure_kinematics(motion.x_m, motion.y_m, motion.z_m, motion.heading_rad)
    known = speed_valid(valid)
    changing = speed_valid(known)
    stands = _stands(traffic)
    values: Values = {
        "vehicles that stand, share": stands[motion.agent_type == AgentType.VEHICLE],
        "pedestrians that stand, share": stands[motion.agent_type == AgentType.PEDESTRIAN],
        "off-road vehicles, share": _off_road(scene, traffic, ~stands & ~stands | stands),
        "off-road moving vehicles, share": _off_road(scene, traffic, ~stands),
        "speed of the ego": found.speed_mps[0, traffic.ego][known[traffic.ego]],
    }
    for agent_type in (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST):
        goes = (~stands & (motion.agent_type == agent_type))[:, None]
        name = agent_type.name.lower()
        values[f"speed of {name}s that move"] = found.speed_mps[0][goes & known]
        values[f"acceleration of {name}s that move"] = found.accel_mps2[0][goes & changing]
        values[f"yaw rate of {name}s that move"] = found.yaw_rate_rad_s[0][goes & known]
        values[f"yaw acceleration of {name}s that move"] = found.yaw_accel_rad_s2[0][
            goes & changing
        ]
        values[f"length of {name}s"] = motion.size_lwh_m[motion.agent_type == agent_type, 0]
        values[f"width of {name}s"] = motion.size_lwh_m[motion.agent_type == agent_type, 1]
    return values


def _stands(traffic: Traffic) -> np.ndarray:
    motion, valid = traffic.motion, traffic.motion.valid[0]
    first = valid.argmax(axis=1)
    rows = np.arange(len(valid))
    x_m, y_m = motion.x_m[0], motion.y_m[0]
    away_m = np.hypot(x_m - x_m[rows, first][:, None], y_m - y_m[rows, first][:, None])
    return np.asarray(np.where(valid, away_m, 0.0).max(axis=1) < STILL_M)


def _off_road(scene: Scene, traffic: Traffic, which: np.ndarray) -> np.ndarray:
    """Whether some vehicles are off the road now."""
    edges = scene_road_edges(scene)
    rows = np.flatnonzero(
        which & (traffic.motion.agent_type == AgentType.VEHICLE) & traffic.there_now
    )
    if edges is None or not len(rows):
        return np.zeros(0, bool)
    now = slice(traffic.now, traffic.now + 1)
    return road_edge_m(traffic.motion, rows, now, edges)[0, :, 0] > 0


def _sight_of(traffic: Traffic) -> Values:
    events, valid = traffic.events, traffic.motion.valid[0]
    pattern = encode_patterns(valid)
    apart_m = _apart_m(traffic)
    return {
        "half seconds seen in part, share": pattern[pattern > 0] < WHOLE_PATTERN,
        "distance of entries": events.entry_distance_m[
            np.isfinite(events.entry_distance_m)
        ],
        "distance of exits": events.exit_distance_m,
        "distance of agents": apart_m[valid],
        "steps seen of a track": valid.sum(axis=1),
    }


def column(scenes: Iterator[Scene]) -> TokenStep:
    """Means over scenes of the counts; shares and quantiles of the pooled values."""
    counts: list[TokenStep] = []
    pooled: dict[str, list[np.ndarray]] = {}
    for scene in scenes:
        try:
            of_scene, values = measure(scene)
        except ValueError as error:
            print(f"<!-- left out: {scene.scenario_id}: {error} -->")
            continue
        counts.append(of_scene)
        for name, some in values.items():
            pooled.setdefault(name, []).append(some)
    found: TokenStep = {"scenes": float(len(counts))}
    found |= {name: float(np.mean([one[name] for one in counts])) for name in counts[0]}
    for name, parts in pooled.items():
        found |= _describe(name, np.concatenate(parts))
    return found


def _describe(name: str, values: np.ndarray) -> TokenStep:
    if values.dtype == bool:
        return {name: float(values.mean()) if len(values) else np.nan}
    finite = values[np.isfinite(values)]
    if not len(finite):
        return {}
    quantiles: Sequence[float] = QUANTILES
    if name.startswith(("acceleration", "yaw")):
        finite, quantiles = np.abs(finite), (50, 90, 99)
    at = np.percentile(finite, quantiles)
    return {f"{name}, {of:g} %": float(v) for of, v in zip(quantiles, at, strict=True)}


def read(pattern: str, most: int) -> Iterator[Scene]:
    """Stream scenes of some files, evenly from all of them; broken records are passed over.

    Raises:
        FileNotFoundError: if there are no such files.
    """
    paths = sorted(glob(pattern))
    if not paths:
        raise FileNotFoundError(f"no records match {pattern}")
    each = -(-most // len(paths)) if most else None
    for path in paths:
        whole = (found for found in iter_scenes(path) if isinstance(found, Scene))
        yield from islice(whole, each)


def print_table(columns: Mapping[str, TokenStep]) -> None:
    """Print the columns as a Markdown table."""
    print("| | " + " | ".join(columns) + " |")
    print("|---|" + "---:|" * len(columns))
    for name in dict.fromkeys(name for one in columns.values() for name in one):
        cells = [
            f"{one.get(name, np.nan):.3g}".replace("nan", "-") for one in columns.values()
        ]
        print(f"| {name} | " + " | ".join(cells) + " |")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--towns", default=f"{BUILT_IN}/*.tfrecord*")
    parser.add_argument("--real", default=f"{SHARED}/validation.tfrecord*")
    parser.add_argument(
        "--scenes", type=int, default=40, help="about so many of each; 0: all"
    )
    options = parser.parse_args(arguments)
    columns = {
        name: column(read(pattern, options.scenes))
        for name, pattern in (("towns", options.towns), ("real", options.real))
        if glob(pattern)
    }
    print_table(columns)
    figures = {
        name: {key: round(value, 4) for key, value in one.items()}
        for name, one in columns.items()
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
