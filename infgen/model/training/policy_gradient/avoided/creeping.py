"""Creeping: motion tokens by which a vehicle creeps on, with nobody ahead of it.

A vehicle that sets off without need is where hardly a log has one, neither standing nor on
its way, and creeps on for seconds. So do logged ones, but mostly behind another one. A
token creeps on if it is as slow as those of the two seconds before it, and no other agent
is just ahead. Where one was taken, the vehicle learns to take another (``terms``), to stop
or to speed up: the pretrained network tells how likely either is.
"""

import numpy as np
from jaxtyping import Bool, Int64

from infgen.geometry import to_local
from infgen.model.training.policy_gradient.avoided.tokens import AvoidedTokens
from infgen.model.training.policy_gradient.rewards import SeenAgents
from infgen.model.training.policy_gradient.rollouts import SimulatedRollouts
from infgen.scene import AgentType
from infgen.tokens.vocabulary import MotionVocabulary

CREEPS_M = (0.25, 1.25)
"""Motion tokens longer than the one and no longer than the other creep: 0.5 to 2.5 m/s."""
CREPT_TOKENS = 4
"""Token steps for which a vehicle has crept before it creeps on."""
AHEAD_M, ASIDE_M = 12.0, 2.0
"""An agent whose middle is no farther ahead and to a side is what a vehicle waits for."""


def find_creeping(
    rollouts: SimulatedRollouts, vocabulary: MotionVocabulary
) -> AvoidedTokens:
    """Find which vehicles took a token that creeps on, on the host.

    Args:
        rollouts: Simulated agents.
        vocabulary: Of their motion tokens.
    """
    seen = SeenAgents.of(rollouts)
    way_m = np.linalg.norm(vocabulary.end_pose[int(AgentType.VEHICLE), :, :2], axis=-1)
    least_m, most_m = CREEPS_M
    creeps = (way_m > least_m) & (way_m <= most_m)
    taken = seen.moved & (seen.agent_type == AgentType.VEHICLE)[:, None]
    taken &= creeps[np.maximum(seen.motion_token, 0)]
    on = taken.copy()
    on[:, :CREPT_TOKENS] = False
    for back in range(1, CREPT_TOKENS + 1):
        on[:, back:] &= taken[:, :-back]
    at = np.argwhere(on)
    at = at[~_is_behind(rollouts, seen, at)]
    avoided = np.broadcast_to(creeps, (len(at), len(creeps)))
    return AvoidedTokens.where_some(at, avoided, len(at), rollouts.moved.device)


def _is_behind(
    rollouts: SimulatedRollouts, seen: SeenAgents, at: Int64[np.ndarray, "row 3"]
) -> Bool[np.ndarray, " row"]:
    """Tell who has another agent ahead before a token step."""
    rollout, token, agent = at.T
    others, own = seen.pose[rollout, token - 1], seen.pose[rollout, token - 1, agent]
    there = rollouts.batch.agents.visible.numpy(force=True)[rollout, token - 1]
    there[np.arange(len(at)), agent] = False
    place_m = to_local(others, np.broadcast_to(own[:, None], others.shape))
    ahead_m, aside_m = place_m[..., 0], np.abs(place_m[..., 1])
    near = (ahead_m > 0) & (ahead_m <= AHEAD_M) & (aside_m <= ASIDE_M)
    found: np.ndarray = (there & near).any(axis=1)
    return found
