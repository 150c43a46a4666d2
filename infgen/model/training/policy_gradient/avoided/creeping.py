"""Creeping: motion tokens by which a vehicle creeps on, with no other agent ahead.

In rollouts twice as many vehicles as in logs creep for seconds, and most of them, other
than logged ones, not behind another one (``benchmarks/creeping.py``). A token creeps on if
it is as slow as those of the two seconds before it, and no other agent is just ahead. Where
one was taken, the vehicle learns to take another (``terms``), to stop or to speed up: the
pretrained network tells how likely either is. Only what is more of it than in the logs of
the batch counts.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from infgen.geometry import to_local
from infgen.model.batching.batch import Agents
from infgen.model.batching.supervision import preceding
from infgen.model.training.policy_gradient.avoided.tokens import AvoidedTokens
from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    SimulatedRollouts,
)
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
    way_m = np.linalg.norm(vocabulary.end_pose[int(AgentType.VEHICLE), :, :2], axis=-1)
    least_m, most_m = CREEPS_M
    creeps = (way_m > least_m) & (way_m <= most_m)
    at, tokens = _creeping_on(rollouts.batch.agents, rollouts.moved, creeps)
    logged = rollouts.logged
    moved = logged.observed & preceding(logged.visible) & (logged.motion_token >= 0)
    moved[:, :HISTORY_TOKENS] = False
    in_logs, log_tokens = _creeping_on(logged, moved, creeps)
    expected = len(in_logs) / max(log_tokens, 1) * tokens
    avoided = np.broadcast_to(creeps, (len(at), len(creeps)))
    found = AvoidedTokens.where_some(at, avoided, len(at), rollouts.moved.device)
    return replace(found, excess=max(0.0, 1 - expected / max(len(at), 1)))


def _creeping_on(
    agents: Agents, moved: Bool[Tensor, "rollout token agent"], creeps: np.ndarray
) -> tuple[Int64[np.ndarray, "row 3"], int]:
    """Find who creeps on: rollout, token, agent; and count the tokens of vehicles."""
    token = agents.motion_token.numpy(force=True)
    vehicle = (agents.agent_type == int(AgentType.VEHICLE))[:, None] & moved
    asked = vehicle.numpy(force=True)
    taken = asked & creeps[token.clip(0, len(creeps) - 1)] & (token < len(creeps))
    on = taken.copy()
    on[:, :CREPT_TOKENS] = False
    for back in range(1, CREPT_TOKENS + 1):
        on[:, back:] &= taken[:, :-back]
    at = np.argwhere(on)
    return at[~_is_behind(agents, at)], int(asked.sum())


def _is_behind(agents: Agents, at: Int64[np.ndarray, "row 3"]) -> Bool[np.ndarray, " row"]:
    """Tell who has another agent ahead before a token step."""
    rollout, token, agent = at.T
    pose, visible = (x.numpy(force=True) for x in (agents.pose, agents.visible))
    return is_behind(pose[rollout, token - 1], visible[rollout, token - 1], agent)


def is_behind(
    pose: Float[np.ndarray, "row agent 3"],
    there: Bool[np.ndarray, "row agent"],
    agent: Int64[np.ndarray, " row"],
) -> Bool[np.ndarray, " row"]:
    """Tell which agents, one of each row, have another one just ahead.

    Args:
        pose: Of all agents: metres and radians.
        there: Which of them there are.
        agent: Who is asked about.
    """
    each = np.arange(len(agent))
    own = np.broadcast_to(pose[each, agent][:, None], pose.shape)
    place_m = to_local(pose, own)
    ahead_m, aside_m = place_m[..., 0], np.abs(place_m[..., 1])
    near = there & (ahead_m > 0) & (ahead_m <= AHEAD_M) & (aside_m <= ASIDE_M)
    near[each, agent] = False
    found: np.ndarray = near.any(axis=1)
    return found
