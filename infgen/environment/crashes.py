"""What ends an episode, by the code of the metrics: collisions, and leaving the road."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32

from infgen.environment.world import Agents
from infgen.metrics.interaction import nearest_object_m
from infgen.metrics.motion import Motion
from infgen.metrics.road import NO_ROAD_M, road_edge_m
from infgen.rollout.population import EGO_ROW
from infgen.spatial.road_edges import RoadEdges

REACH_M = 30.0
"""Agents farther from an ego do not touch it."""


def nearest_agent_m(agents: Agents) -> Float32[np.ndarray, " environment"]:
    """Distance of each ego's box to the nearest other, negative where they overlap.

    ``interaction.NO_OBJECT_M`` where no agent is within ``REACH_M``.
    """
    ego_m = agents.pose[:, EGO_ROW, None, :2]
    away_m = np.abs(agents.pose[..., :2] - ego_m).max(axis=-1)
    near = agents.there & (away_m < REACH_M)
    near[:, EGO_ROW] = True
    environment, row = np.nonzero(near)
    # One rollout, in which each environment is a step: agents meet only their own.
    count = len(near)
    valid = environment[:, None] == np.arange(count)
    # Relative to the ego: what float32 holds does not depend on where the scene is.
    x_m, y_m = (agents.pose[environment, row, :2] - ego_m[environment, 0]).T
    motion = _as_motion(
        np.stack([x_m, y_m, agents.pose[environment, row, 2]], axis=1),
        agents.size_lwh_m[environment, row],
        agents.agent_type[environment, row],
        valid,
    )
    egos = np.flatnonzero(row == EGO_ROW)
    return nearest_object_m(motion, egos, slice(None))[
        0, np.arange(count), np.arange(count)
    ]


def off_road_m(
    agents: Agents, edges: Sequence[RoadEdges | None]
) -> Float32[np.ndarray, " environment"]:
    """Signed distance of each ego's corner that is farthest off the road.

    Positive off the road; ``road.NO_ROAD_M`` on a map without road edges. Heights do not
    matter.
    """
    found_m = np.full(len(edges), NO_ROAD_M)
    by_map: dict[int, list[int]] = {}
    for environment, one in enumerate(edges):
        by_map.setdefault(id(one), []).append(environment)
    for places in by_map.values():
        at, one = np.array(places), edges[places[0]]
        if one is None:
            continue
        motion = _as_motion(
            agents.pose[at, EGO_ROW],
            agents.size_lwh_m[at, EGO_ROW],
            agents.agent_type[at, EGO_ROW],
            np.ones((len(places), 1), dtype=bool),
        )
        egos = np.arange(len(places))
        found_m[at] = road_edge_m(motion, egos, slice(None), one)[0, :, 0]
    return found_m


def _as_motion(
    pose: Float32[np.ndarray, "agent 3"],
    size_lwh_m: Float32[np.ndarray, "agent 3"],
    agent_type: np.ndarray,
    valid: Bool[np.ndarray, "agent step"],
) -> Motion:
    """Return boxes that stand still for some steps, their lower sides at height 0."""

    def at_all_steps(values: np.ndarray) -> Float32[np.ndarray, "1 agent step"]:
        steps = np.broadcast_to(values[:, None], valid.shape)
        return steps[None].astype(np.float32)

    return Motion(
        x_m=at_all_steps(pose[:, 0]),
        y_m=at_all_steps(pose[:, 1]),
        z_m=at_all_steps(size_lwh_m[:, 2] / 2),
        heading_rad=at_all_steps(pose[:, 2]),
        size_lwh_m=size_lwh_m,
        agent_type=agent_type,
        valid=valid[None],
    )
