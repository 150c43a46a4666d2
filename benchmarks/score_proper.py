"""What protocol ``proper`` says of simple futures: noise, kept velocity, none, nobody.

Their order is known: the log with noise knows the future, kept velocity and standing still
do not, and an emptied street is worst. Runs on the shared records, or on the built-in ones
where they are absent::

    python benchmarks/score_proper.py [--split long_20s] [--scenes 8]

The last line is one JSON object: every number of each future.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
from futures import kept_velocity, noisy_traffic
from jaxtyping import Int32
from records import SHARED, read_split

from infgen.config import ReferenceSettings
from infgen.metrics.intervals import scene_mean
from infgen.metrics.long_term.binned import bin_traffic
from infgen.metrics.proper.context import read_context
from infgen.metrics.proper.course import follow_course
from infgen.metrics.proper.engineering.measure import read_place
from infgen.metrics.proper.retrieval import LogCourse, retrieve
from infgen.metrics.proper.sample import Frame, Sample, take_sample
from infgen.metrics.proper.scene import References, SceneScores, score_scene
from infgen.metrics.proper.split import flatten, part_sizes, split_numbers
from infgen.metrics.traffic import Traffic, logged_rows, observe_log
from infgen.metrics.windows import cut_windows
from infgen.scene import Scene
from infgen.spatial.road_edges import scene_road_edges
from pipeline.commands.screen import show_table

RADIUS_M = ReferenceSettings().count_radius_m
WINDOW_S = ReferenceSettings().proper_window_s
NOISY = 4
"""Noisy logs of a scene; the other futures are certain, and stand twice."""


def stood_still(traffic: Traffic, num_steps: int) -> Traffic:
    """Let everyone who is there now stand where it is."""
    kept, now = kept_velocity(traffic, num_steps), traffic.now
    still = {}
    for name in ("x_m", "y_m", "z_m", "heading_rad"):
        still[name] = getattr(kept.motion, name).copy()
        still[name][..., now + 1 :] = still[name][..., now : now + 1]
    return replace(kept, motion=replace(kept.motion, **still))


def emptied(traffic: Traffic) -> Traffic:
    """Let everyone but the ego be gone after now."""
    valid = traffic.motion.valid.copy()
    others = np.arange(valid.shape[1]) != traffic.ego
    valid[:, others, traffic.now + 1 :] = False
    return replace(traffic, motion=replace(traffic.motion, valid=valid))


def read_course(scene: Scene) -> LogCourse:
    """Situation and course of a log."""
    log, after = observe_log(scene), scene.tracks.num_steps - 1 - scene.now
    course = follow_course(log, RADIUS_M, cut_windows(after, WINDOW_S, WINDOW_S))
    return LogCourse(scene.scenario_id, read_context(scene, log, RADIUS_M), course)


def score_futures(
    scene: Scene, own: LogCourse, logs: Sequence[LogCourse]
) -> dict[str, SceneScores]:
    """Score every future of a scene."""
    log, after = observe_log(scene), scene.tracks.num_steps - 1 - scene.now
    place = read_place(scene, RADIUS_M, logged_lights=True)
    frame = Frame(cut_windows(after, WINDOW_S, WINDOW_S), WINDOW_S, RADIUS_M, place)
    edges = scene_road_edges(scene)

    def sample(
        traffic: Traffic, ids: Int32[np.ndarray, " agent"], *, logged: bool = False
    ) -> Sample:
        binned = bin_traffic(traffic, edges, RADIUS_M, as_logged=True)
        return take_sample(traffic, binned, ids, frame, logged=logged)

    ids = scene.tracks.id[logged_rows(scene)]
    there = ids[log.there_now]
    others = [one for one in logs if one.scenario_id != scene.scenario_id]
    references = References(others, retrieve(scene.scenario_id, own.context, logs))
    futures = {
        "log + noise": [sample(noisy_traffic(log, seed), ids) for seed in range(NOISY)],
        "kept velocity": 2 * [sample(kept_velocity(log, after), there)],
        "stood still": 2 * [sample(stood_still(log, after), there)],
        "emptied": 2 * [sample(emptied(log), ids)],
    }
    true = sample(log, ids, logged=True)
    return {name: score_scene(true, some, references) for name, some in futures.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print every number of every future."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    usual = "long_20s" if SHARED.is_dir() else "validation"
    parser.add_argument("--split", default=usual)
    parser.add_argument("--scenes", type=int, default=8, help="at most so many; 0 for all")
    asked = parser.parse_args(arguments)
    scenes = list(islice(read_split(asked.split), asked.scenes or None))
    logs = [read_course(scene) for scene in scenes]
    found: dict[str, list[SceneScores]] = {}
    for scene, own in zip(scenes, logs, strict=True):
        for name, scores in score_futures(scene, own, logs).items():
            found.setdefault(name, []).append(scores)
    numbers = {}
    for name, many in found.items():
        sizes = part_sizes(len(many[0].parts["rank/entries"]))
        table = flatten([one.parts for one in many], sizes)
        means = scene_mean(table, np.ones((1, len(table))))
        numbers[name] = {key: float(v[0]) for key, v in split_numbers(means, sizes).items()}
    names = next(iter(numbers.values()), {})
    show_table(
        f"{len(scenes)} logs of {asked.split}",
        ("", *numbers),
        [(name, *[f"{each[name]:.4f}" for each in numbers.values()]) for name in names],
    )
    told = {
        future: {name: round(value, 6) for name, value in each.items() if value == value}
        for future, each in numbers.items()
    }
    print(json.dumps({"scenes": len(scenes), "futures": told}))


if __name__ == "__main__":
    main()
