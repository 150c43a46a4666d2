"""Conflicts: motion tokens after which braking no longer averts an overlap.

An overlap is rare, and its reward tells only of the tokens that were sampled. What other
agents did in a rollout tells more: for every token that an agent might have taken, whether
it would have run into one of them. A token is in conflict if the agent, after it, brakes at
``BRAKES_MPS2`` and still comes to overlap an agent that it had ahead, all others moving as
they did in the rollout. Braking, the agent keeps to the way that it went in the rollout, at
the lateral offset from it at which the token ends. Boxes are compared at the middle and the
end of token steps.

Where an agent comes into conflict, all motion tokens are looked at, and it learns to take
one that is not (``terms``). Nothing is learned of the tokens that follow while it is in
conflict: two in three are such, and hardly a likely token averts it any more. The ego is
told of none, as it drove more slowly with them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.geometry import box_radius_m, boxes_overlap, to_local, to_world, wrap_angle
from infgen.model.training.policy_gradient.avoided.braking import (
    LOOK_AHEAD_TOKENS,
    AgentPath,
    braking_arc_m,
)
from infgen.model.training.policy_gradient.avoided.tokens import AvoidedTokens
from infgen.model.training.policy_gradient.rollouts import SimulatedRollouts
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import EGO
from infgen.tokens.vocabulary import MotionVocabulary


def find_conflicts(
    rollouts: SimulatedRollouts, vocabulary: MotionVocabulary
) -> AvoidedTokens:
    """Find who came into conflict, the ego aside.

    Args:
        rollouts: Simulated agents.
        vocabulary: Of their motion tokens.
    """
    taken = conflicts_taken(rollouts, vocabulary)
    begins = taken.copy()
    begins[:, 1:] &= ~taken[:, :-1]
    begins[..., EGO] = False
    at = np.argwhere(begins)
    every = np.arange(vocabulary.num_motion_tokens)
    choices = np.column_stack([at.repeat(len(every), axis=0), np.tile(every, len(at))])
    found = are_in_conflict(rollouts, choices, vocabulary).reshape(-1, len(every))
    return AvoidedTokens.where_some(at, found, int(taken.sum()), rollouts.moved.device)


def conflicts_taken(
    rollouts: SimulatedRollouts, vocabulary: MotionVocabulary
) -> Bool[np.ndarray, "rollout token agent"]:
    """Tell which motion tokens that were taken are in conflict, on the host.

    Args:
        rollouts: Simulated agents.
        vocabulary: Of their motion tokens.
    """
    moved = rollouts.moved.numpy(force=True)
    motion_token = rollouts.batch.agents.motion_token.numpy(force=True)[moved]
    choices = np.column_stack([np.argwhere(moved), motion_token])
    taken = np.zeros_like(moved)
    taken[moved] = are_in_conflict(rollouts, choices, vocabulary)
    return taken


def are_in_conflict(
    rollouts: SimulatedRollouts,
    choices: Int64[np.ndarray, "choice 4"],
    vocabulary: MotionVocabulary,
) -> Bool[np.ndarray, " choice"]:
    """Tell which motion tokens are in conflict, on the host.

    Args:
        rollouts: Simulated agents.
        choices: Rollout, token step, agent, motion token; those of an agent at a token step
            one after the other.
        vocabulary: Of the motion tokens.
    """
    found = np.zeros(len(choices), dtype=bool)
    seen, token = _Seen.of(rollouts), choices[:, 1]
    for at in np.unique(token).tolist():
        some = np.flatnonzero(token == at)
        rollout, _, agent, motion_token = choices[some].T
        tokens = _Choices.of(seen, at, (rollout, agent), motion_token, vocabulary)
        found[some] = tokens.are_in_conflict(seen)
    return found


@dataclass(frozen=True, slots=True)
class _Seen:
    """Simulated agents on the host, as ``Agents`` has them, twice in a token step.

    Token step t ends at time 2 t. In the middle agents are halfway between two ends.
    """

    pose: Float32[np.ndarray, "rollout time agent 3"]
    size_lw_m: Float32[np.ndarray, "rollout agent 2"]
    agent_type: np.ndarray
    visible: Bool[np.ndarray, "rollout time agent"]

    @classmethod
    def of(cls, rollouts: SimulatedRollouts) -> "_Seen":
        agents = rollouts.batch.agents
        found = agents.pose, agents.visible, agents.size_lwh_m[..., :2], agents.agent_type
        ends, seen, size_lw_m, agent_type = (each.numpy(force=True) for each in found)
        pose, visible = ends.repeat(2, axis=1)[:, 1:], seen.repeat(2, axis=1)[:, 1:]
        change = np.diff(ends, axis=1)
        change[..., 2] = wrap_angle(change[..., 2])
        pose[:, 1::2] -= change / 2
        visible[:, 1::2] &= seen[:, :-1]
        return cls(pose, size_lw_m, agent_type, visible)


@dataclass(frozen=True, slots=True)
class _Choices:
    """Motion tokens that agents might take at a token step, and where they lead.

    Attributes:
        times: Times of ``_Seen`` in this token step and the next ones, without its begin.
        rollout: Of each agent [row].
        agent: Its row in the rollout [row].
        row: Whose each motion token is, in order [choice].
        pose: Poses after it, and then braking, at the times [choice, time, 3].
        reach_m: Longest way of each agent until each time [row, time].
    """

    times: slice
    rollout: Int64[np.ndarray, " row"]
    agent: Int64[np.ndarray, " row"]
    row: Int64[np.ndarray, " choice"]
    pose: Float32[np.ndarray, "choice time 3"]
    reach_m: Float32[np.ndarray, "row time"]

    @classmethod
    def of(
        cls,
        seen: _Seen,
        token: int,
        of: tuple[np.ndarray, np.ndarray],
        motion_token: np.ndarray,
        vocabulary: MotionVocabulary,
    ) -> "_Choices":
        """Brake after every motion token, all agents ``of`` one after the other."""
        rollout, agent = of
        first = np.ones(len(rollout), dtype=bool)
        first[1:] = (np.diff(rollout) != 0) | (np.diff(agent) != 0)
        row, (rollout, agent) = first.cumsum() - 1, (rollout[first], agent[first])
        begin = 2 * (token - 1)
        times = slice(begin + 1, min(begin + 2 * LOOK_AHEAD_TOKENS + 1, seen.pose.shape[1]))
        at = rollout, slice(begin, times.stop), agent
        path = AgentPath.of(seen.pose[at], seen.visible[at])
        end = vocabulary.end_pose[seen.agent_type[rollout, agent][row], motion_token]
        arc_m = braking_arc_m(end[:, 0].clip(min=0), times.stop - times.start)
        pose = path.at(row, arc_m)
        middle, straight = (to_world(x, path.pose[row, 0]) for x in (end / 2, end))
        aside_m = np.zeros_like(straight)
        aside_m[:, 1] = to_local(straight, pose[:, 1])[:, 1]
        pose = to_world(aside_m[:, None], pose)
        pose[:, 0], pose[:, 1] = middle, straight
        reach_m = np.zeros((len(rollout), arc_m.shape[1]), dtype=np.float32)
        np.maximum.at(reach_m, row, arc_m)
        return cls(times, rollout, agent, row, pose, reach_m)

    def are_in_conflict(self, seen: _Seen) -> Bool[np.ndarray, " choice"]:
        """Tell which of them come to overlap an agent ahead."""
        found = np.zeros(len(self.row), dtype=bool)
        row, time, other = self._near(seen)
        pair, choice = self._with_choices(row)
        row, time, other = row[pair], time[pair], other[pair]
        rollout = self.rollout[row]
        hits = boxes_overlap(
            self.pose[choice, time],
            seen.size_lw_m[rollout, self.agent[row]],
            seen.pose[rollout, self.times.start + time, other],
            seen.size_lw_m[rollout, other],
        )
        found[choice[hits]] = True
        return found

    def _with_choices(self, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Go through all choices of rows: position in ``row``, and choice."""
        count = np.bincount(self.row, minlength=len(self.rollout))
        begin = (count.cumsum() - count)[row]
        count = count[row]
        position = np.arange(len(row)).repeat(count)
        within = np.arange(len(position)) - (count.cumsum() - count)[position]
        return position, begin[position] + within

    def _near(self, seen: _Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Agents ahead that might be run into: row, time, row of the other agent."""
        each, start = np.arange(len(self.rollout)), self.times.start - 1
        others, own = (
            seen.pose[self.rollout, start],
            seen.pose[self.rollout, start, self.agent],
        )
        there = seen.visible[self.rollout, start]
        there[each, self.agent] = False
        ahead_m = to_local(others, np.broadcast_to(own[:, None], others.shape))[..., 0]
        walks = seen.agent_type[self.rollout] == AgentType.PEDESTRIAN
        there &= (ahead_m > 0) & ~(walks & walks[each, self.agent][:, None])
        sizes = seen.size_lw_m[self.rollout]
        size = sizes[each, self.agent]
        reach_m = self.reach_m[..., None] + box_radius_m(sizes)[:, None]
        reach_m += box_radius_m(size)[:, None, None]
        later = seen.pose[self.rollout, self.times]
        near = np.linalg.norm((later - own[:, None, None])[..., :2], axis=-1) < reach_m
        near &= seen.visible[self.rollout, self.times] & there[:, None]
        row, other = near.any(axis=1).nonzero()
        began = boxes_overlap(own[row], size[row], others[row, other], sizes[row, other])
        near[row[began], :, other[began]] = False
        return near.nonzero()
