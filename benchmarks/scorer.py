"""How much one scene's 32 rollouts cost to score, and what the cost depends on.

Runs on the shared validation records, or on the built-in ones where they are absent::

    python benchmarks/scorer.py [--scenes N]

The last line is one JSON object: ``cpu_s_per_scenario`` (the Waymo metric, 32 rollouts, one
core), ``peak_rss_mib``, ``cpu_s_per_long_rollout`` (30 s, both long-term protocols), and
``cpu_s_proper_per_scenario`` (protocol ``proper`` on top of it, 32 rollouts).
"""

import argparse
import json
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from futures import kept_velocity, noisy_future
from records import read_split

from infgen.config import ReferenceSettings, TokenSettings
from infgen.metrics.interaction import nearest_object_m, time_to_collision_s
from infgen.metrics.kinematics import measure_kinematics
from infgen.metrics.long_term.binned import Binned, bin_traffic
from infgen.metrics.proper.context import read_context
from infgen.metrics.proper.engineering.measure import read_place
from infgen.metrics.proper.retrieval import CLIMATOLOGY_LOGS, LogCourse, retrieve
from infgen.metrics.proper.sample import Frame, take_sample
from infgen.metrics.proper.scene import References, score_scene
from infgen.metrics.road import road_edge_m
from infgen.metrics.traffic import Traffic, from_log, logged_rows, observe_log
from infgen.metrics.windows import cut_windows
from infgen.metrics.wosac import metric
from infgen.metrics.wosac.logged import HISTORY_STEPS, LOG_STEPS, LogError, LoggedScene
from infgen.metrics.wosac.rollouts import Rollouts, played
from infgen.metrics.wosac.signals import build_stop_lines, runs_red_light
from infgen.scene import Scene
from infgen.spatial.road_edges import RoadEdges, build_road_edges, scene_road_edges

ROLLOUTS = 32
LONG_STEPS = 300
COUNTS = (1, 8, 32, 64)
FUTURE = slice(HISTORY_STEPS, LOG_STEPS)


def cpu_s(work: Callable[[], Any]) -> float:
    """CPU-seconds of one call."""
    start = time.process_time()
    work()
    return time.process_time() - start


def read_logs(limit: int) -> list[LoggedScene]:
    """Logs that the Waymo metric can score."""
    found = []
    for scene in islice(read_split("validation"), limit or None):
        try:
            log = metric.from_scene(scene)
            metric.score(log, noisy_future(log, 1, seed=0))
        except (LogError, ValueError):
            continue
        found.append(log)
    return found


def time_scenes(logs: Sequence[LoggedScene]) -> np.ndarray:
    """CPU-seconds of each scene with all its rollouts."""
    seconds = []
    for at, log in enumerate(logs):
        future = noisy_future(log, ROLLOUTS, seed=at)
        seconds.append(cpu_s(lambda log=log, future=future: metric.score(log, future)))  # type: ignore[misc]
    return np.array(seconds)


def time_features(log: LoggedScene, future: Rollouts) -> dict[str, float]:
    """CPU-seconds of each feature of one scene."""
    motion, objects = played(log, future), log.evaluated
    paths = (motion.x_m, motion.y_m, motion.z_m, motion.heading_rad)
    edges = build_road_edges(log.edges())
    lines = build_stop_lines(
        log.lane_id, log.lanes(), log.signal_lane_id, log.signal_state, log.signal_stop_m
    )
    return {
        "kinematics": cpu_s(lambda: measure_kinematics(*(p[:, objects] for p in paths))),
        "nearest object": cpu_s(lambda: nearest_object_m(motion, objects, FUTURE)),
        "time to collision": cpu_s(lambda: time_to_collision_s(motion, objects, FUTURE)),
        "road edge": cpu_s(lambda: road_edge_m(motion, objects, FUTURE, edges)),
        "red light": cpu_s(lambda: runs_red_light(motion, objects, lines)),
        "all": cpu_s(lambda: metric.score(log, future)),
    }


def fit(logs: Sequence[LoggedScene], seconds: np.ndarray) -> dict[str, float]:
    """Milliseconds per agent, evaluated agent and thousand map points, by least squares."""
    columns: dict[str, list[float]] = {
        "agent": [len(log.sim_rows) for log in logs],
        "evaluated agent": [len(log.evaluated) for log in logs],
        "1000 road-edge points": [len(log.edge_m) / 1000 for log in logs],
        "1000 lane points": [len(log.lane_m) / 1000 for log in logs],
    }
    table = np.column_stack([*columns.values(), np.ones(len(logs))])
    found = np.linalg.lstsq(table, 1000 * seconds, rcond=None)[0]
    return dict(zip([*columns, "scene"], found.tolist(), strict=True))


def time_counts(log: LoggedScene) -> dict[int, float]:
    """CPU-seconds of one scene against the number of rollouts."""
    most = noisy_future(log, max(COUNTS), seed=0)
    seconds = {}
    for count in COUNTS:
        axes = ("x_m", "y_m", "z_m", "heading_rad")
        future = replace(most, **{axis: getattr(most, axis)[:count] for axis in axes})
        seconds[count] = cpu_s(lambda future=future: metric.score(log, future))  # type: ignore[misc]
    return seconds


def time_long(limit: int) -> float:
    """CPU-seconds of binning one 30 s rollout under both long-term protocols."""
    seconds = []
    for scene in islice(read_split("validation"), limit or None):
        try:
            traffic = kept_velocity(from_log(scene, TokenSettings()), LONG_STEPS)
        except ValueError:
            continue
        edges = scene_road_edges(scene)
        seconds.append(cpu_s(lambda t=traffic, e=edges: _bin(t, e)))  # type: ignore[misc]
    return float(np.mean(seconds))


def time_proper(limit: int) -> float:
    """CPU-seconds of protocol ``proper`` for a scene with all its rollouts, once binned.

    The log stands for each of its rollouts here, so that they last as long as it does.
    """
    seconds = []
    for scene in islice(read_split("validation"), limit or None):
        log, edges = observe_log(scene), scene_road_edges(scene)
        binned = _bin(log, edges)
        ids = scene.tracks.id[logged_rows(scene)]
        steps = log.motion.x_m.shape[2] - 1 - log.now
        seconds.append(
            cpu_s(lambda a=(scene, log, binned, ids, steps): _score_proper(*a))  # type: ignore[misc]
        )
    return float(np.mean(seconds))


def _score_proper(
    scene: Scene, log: Traffic, binned: Binned, ids: np.ndarray, steps: int
) -> None:
    settings = ReferenceSettings()
    window_s, radius_m = settings.proper_window_s, settings.count_radius_m
    frame = Frame(
        windows=cut_windows(steps, window_s, window_s),
        window_s=window_s,
        radius_m=radius_m,
        place=read_place(scene, radius_m, logged_lights=True),
    )
    samples = [
        take_sample(log, binned, ids, frame, logged=at == 0) for at in range(ROLLOUTS + 1)
    ]
    context = read_context(scene, log, radius_m)
    logs = [
        LogCourse(str(at), context, samples[0].whole_course)
        for at in range(CLIMATOLOGY_LOGS)
    ]
    near = retrieve(scene.scenario_id, context, logs)
    score_scene(samples[0], samples[1:], References(logs, near))


def _bin(traffic: Traffic, edges: RoadEdges | None) -> Binned:
    radius_m = ReferenceSettings().count_radius_m
    return bin_traffic(traffic, edges, radius_m, as_logged=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables and the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=int, default=0, help="at most so many; 0 for all")
    scenes = parser.parse_args(arguments).scenes
    logs = read_logs(scenes)
    seconds = time_scenes(logs)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{len(logs)} scenes x {ROLLOUTS} rollouts")
    for name, value in (
        ("mean", seconds.mean()),
        ("median", np.median(seconds)),
        ("worst", seconds.max()),
    ):
        print(f"  {name:8s} {value:6.3f} CPU-s per scene")
    print(f"  peak     {peak_mib:6.0f} MiB resident")

    middle = logs[int(np.argsort(seconds)[len(seconds) // 2])]
    shares = time_features(middle, noisy_future(middle, ROLLOUTS, seed=0))
    print(f"features of scene {middle.scenario_id} (median cost)")
    for name, value in shares.items():
        print(f"  {name:18s} {value:6.3f} CPU-s  {value / shares['all']:5.0%}")
    print("least squares over the scenes: milliseconds for each")
    for name, value in fit(logs, seconds).items():
        print(f"  {name:22s} {value:7.2f}")
    print(f"rollouts of scene {middle.scenario_id}")
    for count, value in time_counts(middle).items():
        print(f"  {count:4d} {value:6.3f} CPU-s")
    long_s = time_long(scenes)
    print(f"long-term bins of one 30 s rollout, two protocols: {long_s:.3f} CPU-s")
    proper_s = time_proper(scenes)
    print(
        f"protocol proper of one scene x {ROLLOUTS} rollouts, as long as the log: "
        f"{proper_s:.3f} CPU-s"
    )
    figures = {
        "cpu_s_per_scenario": round(float(seconds.mean()), 4),
        "cpu_s_worst": round(float(seconds.max()), 4),
        "peak_rss_mib": round(peak_mib, 1),
        "cpu_s_per_long_rollout": round(long_s, 4),
        "cpu_s_proper_per_scenario": round(proper_s, 4),
        "scenes": len(logs),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
