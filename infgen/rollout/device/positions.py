"""The insertion mask of ``infgen.rollout.rules.insertion_mask`` on a device."""

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.batching.frames import to_world
from infgen.model.token_step import TokenStep
from infgen.rollout.device.geometry import boxes_overlap
from infgen.rollout.rules.insertion_mask import FAR_M, InsertionMask
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import Presence


class DeviceMask:
    """Lanes of the maps of a batch, and the end poses of motion tokens, on a device."""

    def __init__(self, mask: InsertionMask, device: torch.device) -> None:
        """Bring a mask to a device; maps are padded to the one with the most lanes."""
        shape = (len(mask.lanes), max(len(start_m) for start_m, _ in mask.lanes), 2)
        start_m, along_m = np.full(shape, FAR_M), np.zeros(shape, dtype=np.float32)
        for at, (first_m, step_m) in enumerate(mask.lanes):
            start_m[at, : len(first_m)] = first_m
            along_m[at, : len(first_m)] = step_m
        none = np.array([not len(first_m) for first_m, _ in mask.lanes])
        self._lane_m = mask.squares.reach_m
        self._start_m = torch.from_numpy(start_m).to(device)
        self._along_m = torch.from_numpy(along_m).to(device)
        self._no_lanes = torch.from_numpy(none[mask.scene]).to(device)
        self._scene = torch.from_numpy(mask.scene.copy()).to(device)
        self._end_pose = torch.from_numpy(mask.end_pose.copy()).to(device)

    def soon(self, token_step: TokenStep) -> Float32[Tensor, "rollout row 3"]:
        """Poses one token step ahead if every agent repeats its motion token."""
        moves = token_step.motion_token >= 0
        step = self._end_pose[token_step.agent_type, token_step.motion_token.clamp(min=0)]
        return to_world(step * moves[..., None], token_step.pose)

    def allows(
        self,
        token_step: TokenStep,
        soon: Float32[Tensor, "rollout row 3"],
        rollout: Int64[Tensor, " inserted"],
        pose: Float32[Tensor, "inserted 3"],
        agent_type: Int64[Tensor, " inserted"],
        size_lwh_m: Float32[Tensor, "inserted 3"],
    ) -> Bool[Tensor, " inserted"]:
        """Tell which agents have an allowed position.

        Args:
            token_step: All agents.
            soon: Their poses one token step ahead.
            rollout: Where each is to be inserted.
            pose: Poses.
            agent_type: ``AgentType``.
            size_lwh_m: Boxes.
        """
        everyone = torch.stack([token_step.pose[rollout], soon[rollout]])
        meets = boxes_overlap(
            pose[:, None],
            size_lwh_m[:, None, :2],
            everyone,
            token_step.size_lwh_m[rollout][..., :2],
        ).any(dim=0)
        walkers = token_step.agent_type[rollout] == int(AgentType.PEDESTRIAN)
        walkers &= (agent_type == int(AgentType.PEDESTRIAN))[:, None]
        there = token_step.presence[rollout] != int(Presence.ABSENT)
        overlaps = (meets & there & ~walkers).any(dim=1)
        by_lane = self._near_lane(pose[:, :2], rollout) | self._no_lanes[rollout]
        return (by_lane | (agent_type != int(AgentType.VEHICLE))) & ~overlaps

    def _near_lane(self, xy_m: Tensor, rollout: Tensor) -> Tensor:
        """Whether points have a lane of their map within the distance."""
        if not self._start_m.shape[1]:
            return torch.zeros_like(rollout, dtype=torch.bool)
        scene = self._scene[rollout]
        along_x_m, along_y_m = self._along_m[scene].unbind(-1)  # [point, lane]
        x_m, y_m = (xy_m[:, None] - self._start_m[scene]).unbind(-1)
        length2 = (along_x_m * along_x_m + along_y_m * along_y_m).clamp(min=1e-6)
        share = ((x_m * along_x_m + y_m * along_y_m) / length2).clamp(0, 1)
        gap_m = torch.hypot(x_m - share * along_x_m, y_m - share * along_y_m)
        return (gap_m <= self._lane_m).any(dim=1)
