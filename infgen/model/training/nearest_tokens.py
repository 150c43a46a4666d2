"""The nearest motion token and where it leads, on tensors: ``tokens.moves`` for any device.

Distances are float64 throughout, so neither autocast nor a GPU's short-cuts in matrix
products touch them.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from infgen.model.batching.frames import rotate
from infgen.tokens.motion_tokens import make_match_table
from infgen.tokens.vocabulary import MotionVocabulary

_ROWS_AT_ONCE = 1024
"""Keeps the table of gaps (rows x motion tokens) within 16 MiB."""


@dataclass(frozen=True, slots=True)
class MotionTokenEnds:
    """Where the motion tokens of a vocabulary end; as ``tokens.motion_tokens.MatchTable``.

    Attributes:
        pose: In the frame of each move's start.
        size_lw_m: Box that moves of each agent type are compared by.
        reach_m: Half the diagonal of that box.
        weights: Of the squared distance of two spreads.
        corners_m: Corners of the box at each end: x of the four, then y.
    """

    pose: Float32[Tensor, "3 motion_token 3"]
    size_lw_m: Float64[Tensor, "3 2"]
    reach_m: Float64[Tensor, " 3"]
    weights: Float64[Tensor, "3 5 motion_token"]
    corners_m: Float64[Tensor, "3 motion_token 8"]

    @classmethod
    def of(cls, vocabulary: MotionVocabulary, device: torch.device) -> "MotionTokenEnds":
        """Lay a vocabulary out on a device."""
        table = make_match_table(vocabulary)
        pose = torch.from_numpy(vocabulary.end_pose.copy()).to(device)
        reach_m = torch.from_numpy(table.reach_m).to(device).double()
        spread = _spread(pose.double(), reach_m[:, None])
        square = spread.square().sum(dim=-1, keepdim=True)
        return cls(
            pose=pose,
            size_lw_m=torch.from_numpy(vocabulary.size_lw_m).to(device).double(),
            reach_m=reach_m,
            weights=torch.cat([-2 * spread, square], dim=-1).transpose(1, 2),
            corners_m=torch.from_numpy(table.corners_m).to(device),
        )


def nearest(
    wanted: Float32[Tensor, "row 3"],
    agent_type: Int64[Tensor, " row"],
    ends: MotionTokenEnds,
) -> Int64[Tensor, " row"]:
    """Find the motion token that ends nearest to each pose wanted (in its start's frame).

    The same as ``tokens.motion_tokens.nearest_motion_tokens``: of equally near motion
    tokens the first.
    """
    if wanted.device.type != "cpu":
        return _measured(wanted, agent_type, ends)
    motion_token = torch.empty_like(agent_type)
    for number in range(len(ends.pose)):
        for rows in torch.split((agent_type == number).nonzero()[:, 0], _ROWS_AT_ONCE):
            motion_token[rows] = _nearest(wanted[rows].double(), number, ends)
    return motion_token


def nearest_of(
    wanted: Float32[Tensor, "row 3"],
    agent_type: Int64[Tensor, " row"],
    choice: Int64[Tensor, "row choice"],
    ends: MotionTokenEnds,
) -> Int64[Tensor, " row"]:
    """Find the motion token of some that ends nearest to each pose wanted.

    Args:
        wanted: Where to, in the frame of each move's start.
        agent_type: ``AgentType`` of each row.
        choice: The motion tokens to choose from; of equally near ones the first.
        ends: Where motion tokens end.
    """
    aim_m = _corners(wanted.double(), ends.size_lw_m[agent_type])
    gap_m = _mean_gap(ends.corners_m[agent_type[:, None], choice], aim_m[:, None])
    return choice.gather(1, gap_m.argmin(dim=1, keepdim=True))[:, 0]


def _measured(wanted: Tensor, agent_type: Tensor, ends: MotionTokenEnds) -> Tensor:
    """The same by measuring all motion tokens: to choose few makes the host wait."""
    found = []
    parts = (torch.split(x, _ROWS_AT_ONCE) for x in (wanted.double(), agent_type))
    for aim, own in zip(*parts, strict=True):
        aim_m = _corners(aim, ends.size_lw_m[own])
        found.append(_mean_gap(ends.corners_m[own], aim_m[:, None]).argmin(dim=1))
    return torch.cat(found)


def _nearest(wanted: Tensor, number: int, ends: MotionTokenEnds) -> Tensor:
    """Return the nearest motion token of one agent type to each pose wanted (float64)."""
    aim_m = _corners(wanted, ends.size_lw_m[number])
    row, motion_token = _candidates(wanted, aim_m, number, ends)
    gap_m = _mean_gap(ends.corners_m[number, motion_token], aim_m[row])
    far_m = gap_m.new_full((len(wanted),), torch.inf)
    least_m = far_m.scatter_reduce(0, row, gap_m, "amin")
    best = torch.where(gap_m == least_m[row], motion_token, ends.pose.shape[1])
    last = row.new_full((len(wanted),), ends.pose.shape[1])
    return last.scatter_reduce(0, row, best, "amin")


def _candidates(
    wanted: Tensor, aim_m: Tensor, number: int, ends: MotionTokenEnds
) -> tuple[Tensor, Tensor]:
    """Return rows and motion tokens; each row's nearest motion token is among them."""
    spread = _spread(wanted, ends.reach_m[number])
    square = spread.square().sum(dim=-1, keepdim=True)
    weights = ends.weights[number]
    gap = spread @ weights[:4] + weights[4] + square  # [row, motion_token]
    guess_m = _mean_gap(ends.corners_m[number, gap.argmin(dim=1)], aim_m)
    # The nearest motion token is no farther than the guess, its spread at most 1.42 times.
    most = 2 * guess_m.square() + 1e-9 * (1 + square[:, 0])  # With room for rounding.
    row, motion_token = (gap <= most[:, None]).nonzero(as_tuple=True)
    return row, motion_token


def _mean_gap(one_m: Tensor, other_m: Tensor) -> Tensor:
    """Return the mean distance of four corners; arrays are [..., 8]: all x, then all y."""
    away_m = (one_m - other_m).square()
    return (away_m[..., :4] + away_m[..., 4:]).sqrt().sum(dim=-1) / 4


def _corners(pose: Tensor, size_lw_m: Tensor) -> Tensor:
    """Return the corners [row, 8] of boxes: x of all four, then y of all four."""
    signs = _signs(pose.dtype, pose.device)
    corners_m = rotate(size_lw_m[..., None, :] * signs, pose[:, None, 2])
    return (corners_m + pose[:, None, :2]).transpose(1, 2).flatten(1)


@lru_cache(maxsize=4)
def _signs(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Where the corners of a box are, in lengths and widths; copied to a device once."""
    signs = [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    return torch.tensor(signs, dtype=dtype, device=device) / 2


def _spread(pose: Tensor, reach_m: Tensor) -> Tensor:
    heading = pose[..., 2]
    turned_m = reach_m * heading.cos(), reach_m * heading.sin()
    return torch.stack([pose[..., 0], pose[..., 1], *turned_m], dim=-1)
