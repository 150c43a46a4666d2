"""Rollouts that replay a log, with as many agents and steps as a test asks for."""

from dataclasses import replace

import numpy as np

from infgen.rollout.rollout import NEVER, Rollout
from infgen.scene import Scene
from infgen.sources.womd import decode_scene
from tests.sources.records import small_scenario


def replay(scene: Scene, index: int = 0, shift_m: float = 0.0) -> Rollout:
    """The log of everyone there now, moved aside after now; all stay to the end."""
    tracks = scene.tracks
    rows = np.flatnonzero(tracks.valid[:, scene.now])
    future = np.arange(tracks.num_steps) > scene.now
    valid = tracks.valid[rows] | future
    last = np.maximum.accumulate(
        np.where(tracks.valid[rows], np.arange(tracks.num_steps), 0), axis=1
    )
    xyz_m = np.take_along_axis(tracks.xyz_m[rows], last[..., None], axis=1)
    xyz_m = np.where(valid[..., None], xyz_m, 0)
    xyz_m[:, future, 1] += shift_m
    heading_rad = np.take_along_axis(tracks.heading_rad[rows], last, axis=1)
    return Rollout(
        scenario_id=scene.scenario_id,
        index=index,
        seed=index,
        weights="none",
        origin_xyz_m=scene.origin_xyz_m,
        now=scene.now,
        ego=int(np.flatnonzero(rows == scene.ego)[0]),
        id=tracks.id[rows],
        agent_type=tracks.agent_type[rows],
        size_lwh_m=tracks.size_lwh_m[rows, scene.now],
        xyz_m=xyz_m.astype(np.float32),
        heading_rad=np.where(valid, heading_rad, 0).astype(np.float32),
        valid=valid,
        logged=np.ones(len(rows), bool),
        entry_step=np.zeros(len(rows), np.int16),
        exit_step=np.full(len(rows), NEVER, np.int16),
    )


def decoded_small() -> Scene:
    """Twelve steps of two agents on a map with features of every kind, and a light."""
    return decode_scene(small_scenario().SerializeToString())


def without(rollout: Rollout, track: int) -> Rollout:
    """The same without one agent."""
    keep = rollout.id != track
    per_agent = ("id", "agent_type", "size_lwh_m", "xyz_m", "heading_rad", "valid")
    per_agent += ("logged", "entry_step", "exit_step")
    changed = {name: getattr(rollout, name)[keep] for name in per_agent}
    ego = int(np.flatnonzero(changed["id"] == rollout.id[rollout.ego])[0])
    return replace(rollout, **changed, ego=ego)


def with_newcomer(rollout: Rollout, step: int) -> Rollout:
    """One more agent, inserted at a step 5 m beside the ego; it is there from then on."""
    valid = np.arange(rollout.num_steps) > step
    where = rollout.xyz_m[rollout.ego] + np.array([0, 5, 0], np.float32)
    added = {
        "id": rollout.id.max() + 1,
        "agent_type": np.int8(0),
        "size_lwh_m": np.array([4, 2, 1.5], np.float32),
        "xyz_m": np.where(valid[:, None], where, 0).astype(np.float32),
        "heading_rad": np.where(valid, rollout.heading_rad[rollout.ego], np.float32(0)),
        "valid": valid,
        "logged": np.bool_(False),
        "entry_step": np.int16(step),
        "exit_step": np.int16(NEVER),
    }
    return replace(
        rollout,
        **{
            name: np.concatenate([getattr(rollout, name), np.asarray(value)[None]]).astype(
                getattr(rollout, name).dtype
            )
            for name, value in added.items()
        },
    )
