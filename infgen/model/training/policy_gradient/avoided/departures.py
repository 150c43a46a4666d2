"""Departures: motion tokens by which a vehicle drives off the road, or stays off it.

Who has left the road is the network's own doing, as hardly a log has it there; what leads
back is no log's choice either. So most of what drives off the road in rollouts left it long
before. A token departs if the box at its end is off the road and no nearer to it than
before, and if it drives: standing, parked vehicles stay where they are. Where one was
taken, all motion tokens are looked at, and the vehicle learns to take another (``terms``).
"""

import numpy as np
from jaxtyping import Bool, Float32

from infgen.geometry import to_world
from infgen.model.training.policy_gradient.avoided.tokens import AvoidedTokens
from infgen.model.training.policy_gradient.rewards import SeenAgents
from infgen.model.training.policy_gradient.road import Road
from infgen.model.training.policy_gradient.rollouts import SimulatedRollouts
from infgen.scene import AgentType
from infgen.spatial.road_edges import SLACK_M
from infgen.tokens.vocabulary import MotionVocabulary

DRIVES_M = 0.5
"""Motion tokens that go no farther than this do not depart: 1 m/s."""


def find_departures(
    rollouts: SimulatedRollouts, vocabulary: MotionVocabulary, roads: list[Road]
) -> AvoidedTokens:
    """Find which vehicles took a token that departs, on the host.

    Args:
        rollouts: Simulated agents.
        vocabulary: Of their motion tokens.
        roads: Of every scene.
    """
    seen = SeenAgents.of(rollouts)
    end = vocabulary.end_pose[int(AgentType.VEHICLE)]
    drives = np.hypot(end[:, 0], end[:, 1]) > np.float32(DRIVES_M)
    asked = seen.moved & (seen.agent_type == AgentType.VEHICLE)[:, None]
    asked &= drives[np.maximum(seen.motion_token, 0)]
    found_at, found = [np.zeros((0, 3), dtype=np.int64)], [np.zeros((0, len(end)), bool)]
    scene = np.arange(len(asked)) % len(roads)
    for number, road in enumerate(roads):
        at = np.argwhere(asked & (scene == number)[:, None, None])
        rollout, token, agent = at.T
        before, size = seen.pose[rollout, token - 1, agent], seen.size_lw_m[rollout, agent]
        before_m = road.off_m(before, size)
        after_m = road.off_m(seen.pose[rollout, token, agent], size)
        taken = _departs(before_m, after_m)
        found_at.append(at[taken])
        ends_m = _ends_off_m(road, before[taken], size[taken], end)
        found.append(drives & _departs(before_m[taken, None], ends_m))
    rows, avoided = np.concatenate(found_at), np.concatenate(found)
    order = np.lexsort(rows.T[::-1])
    return AvoidedTokens.where_some(
        rows[order], avoided[order], len(rows), rollouts.moved.device
    )


def _departs(
    before_m: Float32[np.ndarray, "*#end"], after_m: Float32[np.ndarray, "*end"]
) -> Bool[np.ndarray, "*end"]:
    """Tell, by signed distances off the road, what ends off it and no nearer to it."""
    slack_m = np.float32(SLACK_M)
    departs: np.ndarray = (after_m > slack_m) & (after_m > before_m - slack_m)
    return departs


def _ends_off_m(
    road: Road,
    pose: Float32[np.ndarray, "row 3"],
    size_lw_m: Float32[np.ndarray, "row 2"],
    end: Float32[np.ndarray, "motion_token 3"],
) -> Float32[np.ndarray, "row motion_token"]:
    """Signed distances off the road at the ends of all motion tokens."""
    ends = to_world(end, pose[:, None])
    off_m = road.off_m(ends.reshape(-1, 3), size_lw_m.repeat(len(end), axis=0))
    by_token: np.ndarray = off_m.reshape(len(pose), len(end))
    return by_token
