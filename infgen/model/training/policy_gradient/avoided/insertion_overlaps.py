"""Insertion overlaps: cells, offset tokens and headings that put an agent onto another one.

That an inserted agent overlaps another is rare, and its reward tells only of the place that
was sampled. Where the others are tells more: for every other cell, offset token and heading
that might have been sampled for an agent, whether its box would overlap one of them, all
else about the agent as it was. The network learns to sample one that does not, of each of
the three choices, at every insertion; of cells, one near to the sampled one, so that who
would have parked in a row is put beside it, not on a lane far away.

Others are those present, each with what its box sweeps in the next token step if it moves
on, and those inserted in turns before. Two pedestrians may overlap: groups walk closer than
their boxes.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.geometry import box_radius_m, boxes_overlap, wrap_angle
from infgen.model.batching.batch import Details
from infgen.model.batching.steps import steps_m
from infgen.model.insertion.agent_spacing import swept
from infgen.model.training.policy_gradient.rollouts import SimulatedRollouts
from infgen.scene import AgentType
from infgen.tokens.grid import Grid, to_grid
from infgen.tokens.scene_tokens import EGO, Presence

AHEAD_RAD = np.float32(np.pi / 2)
"""The ego's own heading in its grid frame."""
NEAR_M = 12.0
"""Cells farther from the sampled one keep their odds beside all of these together."""
PAIRS_AT_ONCE = 1024
"""Pairs of agents whose distances in every cell are in memory at once (16 MB)."""


@dataclass(frozen=True, slots=True)
class InsertionOverlaps:
    """Which choices of insertions overlap another agent, the two others as they were.

    Attributes:
        at: Rollout, and place among its details, of each inserted agent.
        cell: Cells that do ...
        offset: ... offset tokens ...
        heading: ... and heading bins.
        near: Cells no farther than ``NEAR_M`` from the sampled one.
        taken: How many agents were inserted onto another.
    """

    at: Int64[Tensor, "inserted 2"]
    cell: Bool[Tensor, "inserted cell"]
    offset: Bool[Tensor, "inserted offset"]
    heading: Bool[Tensor, "inserted heading"]
    near: Bool[Tensor, "inserted cell"]
    taken: int

    @classmethod
    def none(cls, grid: Grid, device: torch.device) -> "InsertionOverlaps":
        """Return none at all."""
        sizes = grid.num_cells, len(grid.offset_m), grid.num_headings
        cell, offset, heading = (
            torch.zeros((0, size), dtype=torch.bool, device=device) for size in sizes
        )
        at = torch.zeros((0, 2), dtype=torch.int64, device=device)
        return cls(at, cell, offset, heading, cell, 0)

    def only(self, rows: slice) -> "InsertionOverlaps":
        """Take those of some rollouts, numbered from the first of them."""
        rollout = self.at[:, 0]
        some = (rollout >= rows.start) & (rollout < rows.stop)
        at = self.at[some]
        at[:, 0] -= rows.start
        return InsertionOverlaps(
            at,
            self.cell[some],
            self.offset[some],
            self.heading[some],
            self.near[some],
            self.taken,
        )


def find_insertion_overlaps(rollouts: SimulatedRollouts, grid: Grid) -> InsertionOverlaps:
    """Find which choices would have put inserted agents onto others, on the host.

    Args:
        rollouts: Simulated agents.
        grid: Cells around the ego.
    """
    seen = _Inserted.of(rollouts, grid)
    cell_m, offset_m = grid.centre_m[seen.cell], grid.offset_m[seen.offset]
    all_headings_rad = grid.heading_centre_rad + AHEAD_RAD
    heading_rad = all_headings_rad[seen.heading]
    position_m = cell_m + offset_m
    options = (
        _poses(grid.centre_m + offset_m[:, None], heading_rad[:, None]),
        _poses(cell_m[:, None] + grid.offset_m, heading_rad[:, None]),
        _poses(position_m[:, None], all_headings_rad[None]),
    )
    found = [seen.overlapping(each) for each in options]
    taken = int(found[0][np.arange(len(seen.at)), seen.cell].sum())
    away_m = np.linalg.norm(grid.centre_m - cell_m[:, None], axis=2)
    device = rollouts.moved.device
    at, cell, offset, heading, near = (
        torch.from_numpy(each).to(device) for each in (seen.at, *found, away_m <= NEAR_M)
    )
    return InsertionOverlaps(at, cell, offset, heading, near, taken)


def _poses(
    position_m: Float32[np.ndarray, " inserted #option 2"],
    heading_rad: Float32[np.ndarray, " #inserted #option"],
) -> Float32[np.ndarray, "inserted option 3"]:
    """Put positions and headings together."""
    shape = np.broadcast_shapes(position_m.shape[:2], heading_rad.shape)
    pose = np.empty((*shape, 3), dtype=np.float32)
    pose[..., :2], pose[..., 2] = position_m, heading_rad
    return pose


@dataclass(frozen=True, slots=True)
class _Inserted:
    """Inserted agents, and the others that are there, in the grid frame of their ego.

    Attributes:
        at: Rollout, and place among its details [inserted, 2].
        cell: Cell ...
        offset: ... offset token ...
        heading: ... and heading bin of each [inserted].
        size_lw_m: Its box.
        whose: Which of them each pair is of, in order [pair].
        other: Pose of the box that the other agent sweeps ...
        other_size_lw_m: ... and its size.
    """

    at: Int64[np.ndarray, "inserted 2"]
    cell: np.ndarray
    offset: np.ndarray
    heading: np.ndarray
    size_lw_m: Float32[np.ndarray, "inserted 2"]
    whose: Int64[np.ndarray, " pair"]
    other: Float32[np.ndarray, "pair 3"]
    other_size_lw_m: Float32[np.ndarray, "pair 2"]

    @classmethod
    def of(cls, rollouts: SimulatedRollouts, grid: Grid) -> "_Inserted":
        """Find all inserted agents, and the others that each might overlap."""
        agents, details = rollouts.batch.agents, rollouts.batch.details
        size_lw_m = agents.size_lwh_m[:, None, :, :2].expand(*agents.pose.shape[:3], 2)
        swept_pose, swept_lw_m = swept(agents.pose, size_lw_m, steps_m(agents), 1.0)
        at = (details.present & details.inserted).nonzero().numpy(force=True)
        rollout, _ = at.T
        own = _told(details, at)
        pose, sweeps, swept_lw_m, presence, turn, came, agent_type, size_lw_m = (
            each.numpy(force=True)[where]
            for each, where in (
                (agents.pose, (rollout, own.token)),
                (swept_pose, (rollout, own.token)),
                (swept_lw_m, (rollout, own.token)),
                (agents.presence, (rollout, own.token)),
                (agents.turn, (rollout, own.token)),
                (rollouts.inserted, (rollout, own.token)),
                (agents.agent_type, rollout),
                (agents.size_lwh_m[..., :2], rollout),
            )
        )
        there = (presence != Presence.ABSENT) & ~(came & (turn >= own.turn[:, None]))
        walks = agent_type == AgentType.PEDESTRIAN
        own_size_lw_m = size_lw_m[np.arange(len(at)), own.agent]
        there &= ~(walks & walks[np.arange(len(at)), own.agent][:, None])
        whose, row = there.nonzero()
        ego_pose, other_pose = pose[whose, EGO], sweeps[whose, row]
        other = np.empty((len(whose), 3), dtype=np.float32)
        other[:, :2] = to_grid(other_pose[:, :2], ego_pose)
        other[:, 2] = wrap_angle(other_pose[:, 2] - ego_pose[:, 2]) + AHEAD_RAD
        return cls(
            at,
            own.cell,
            own.offset,
            own.heading,
            own_size_lw_m,
            whose,
            other,
            swept_lw_m[whose, row],
        )

    def overlapping(
        self, options: Float32[np.ndarray, "inserted option 3"]
    ) -> Bool[np.ndarray, "inserted option"]:
        """Tell which of the poses that each agent might have overlap another one."""
        found = np.zeros(options.shape[:2], dtype=bool)
        reach_m = box_radius_m(self.size_lw_m)[self.whose] + box_radius_m(
            self.other_size_lw_m
        )
        for first in range(0, len(self.whose), PAIRS_AT_ONCE):
            some = slice(first, first + PAIRS_AT_ONCE)
            whose, other = self.whose[some], self.other[some]
            away_m = options[whose, :, :2] - other[:, None, :2]
            away2_m2 = np.einsum("poc,poc->po", away_m, away_m)
            pair, option = (away2_m2 < reach_m[some, None] ** 2).nonzero()
            own = whose[pair]
            hits = boxes_overlap(
                options[own, option],
                self.size_lw_m[own],
                other[pair],
                self.other_size_lw_m[some][pair],
            )
            found[own[hits], option[hits]] = True
        return found


@dataclass(frozen=True, slots=True)
class _Told:
    """What is known of inserted agents, on the host, each [inserted]."""

    agent: np.ndarray
    token: np.ndarray
    turn: np.ndarray
    cell: np.ndarray
    offset: np.ndarray
    heading: np.ndarray


def _told(details: Details, at: Int64[np.ndarray, "inserted 2"]) -> _Told:
    names = "agent", "token", "turn", "cell", "offset", "heading"
    rollout, place = at.T
    return _Told(*(getattr(details, x).numpy(force=True)[rollout, place] for x in names))
