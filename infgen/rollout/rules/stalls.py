"""Stall rule: vehicles that stand in a lane without a reason are released.

The network looks back a few seconds. It takes a vehicle that has stood for all of them for
parked and hardly lets it set off again. In a rollout one such vehicle blocks all behind it.
"""

import math
from collections.abc import Sequence
from copy import copy

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64

from infgen.geometry import wrap_angle
from infgen.model.features.signals import StopLines
from infgen.rollout.population import Population
from infgen.rollout.recording import NO_AGENT
from infgen.rollout.rules.off_road import lane_segments
from infgen.scene import AgentType, Scene
from infgen.spatial.lanes import lanes_distance_m
from infgen.tokens.scene_tokens import Presence, SignalClass

AWAY_M = 1.0
"""A vehicle that got no farther has stood."""
IN_LANE_M = 2.0
"""A vehicle this near to a lane centre is in the lane ..."""
ALONG_RAD = math.radians(30)
"""... if their headings differ by less."""
WAITS_M = 15.0
"""A vehicle waits for a signal at most this far ahead."""
RED = (SignalClass.STOP, SignalClass.CAUTION)


class StallRule:
    """Tracks for how long every agent of a batch has stood."""

    def __init__(
        self,
        maps: Sequence[Scene],
        scene: Int64[np.ndarray, " rollout"],
        lines: StopLines,
        tokens: int,
    ) -> None:
        """Start without history.

        Args:
            maps: Scenes with the maps of the batch.
            scene: Map of each rollout.
            lines: Stop lines of those maps.
            tokens: Token steps after which a vehicle has stalled.
        """
        self._lines, self._tokens = lines, tokens
        self._lanes = [lane_segments(one) for one in maps]
        self._start(scene)

    def without_history(self, scene: Int64[np.ndarray, " rollout"]) -> "StallRule":
        """Return the same rule for other rollouts on the same maps."""
        other = copy(self)
        other._start(scene)
        return other

    def _start(self, scene: Int64[np.ndarray, " rollout"]) -> None:
        self._scene = scene
        self._agent_number = np.zeros((len(scene), 0), dtype=np.int32)
        self._from_m = np.zeros((*self._agent_number.shape, 2), dtype=np.float32)
        self._since = np.zeros(self._agent_number.shape, dtype=np.int64)
        self._in_lane = np.zeros(self._agent_number.shape, dtype=bool)
        self._begun = np.zeros(len(scene), dtype=np.int64)

    def go_on_from(
        self,
        other: "StallRule",
        replaced: Int64[np.ndarray, " replaced"],
        begun: Int64[np.ndarray, " rollout"],
    ) -> None:
        """Take over what another rule knows of agents, but for replaced rollouts.

        Args:
            other: Of the same batch on other maps.
            replaced: Rollouts that took the place of others.
            begun: Token step of the batch that is the first of each rollout's own.
        """
        self._agent_number = other._agent_number.copy()
        self._agent_number[replaced] = NO_AGENT
        self._from_m, self._since = other._from_m, other._since
        self._in_lane, self._begun = other._in_lane, begun

    def stalled(self, everyone: Population, token: int) -> Bool[np.ndarray, "rollout row"]:
        """Tell which vehicles have stalled in a lane; call it at every token step.

        Vehicles that wait for a signal have not stalled.

        Args:
            everyone: All agents at the end of the token step.
            token: Index of the token step.
        """
        self._remember(everyone, token)
        stood = token - self._since
        vehicle = (everyone.agent_type == AgentType.VEHICLE) & (
            everyone.agent_number != NO_AGENT
        )
        vehicle &= everyone.presence != Presence.REMOVED
        new = vehicle & (stood == self._tokens)
        self._in_lane[new] = self._are_in_lane(everyone.pose[new], np.nonzero(new)[0])
        stalled = vehicle & (stood >= self._tokens) & self._in_lane
        stalled[stalled] = ~self._wait(
            everyone.pose[stalled], np.nonzero(stalled)[0], token
        )
        return stalled

    def _remember(self, everyone: Population, token: int) -> None:
        """Update since when each agent stands; rows with a new agent start anew."""
        xy_m = everyone.pose[..., :2]
        more = everyone.agent_number.shape[1] - self._agent_number.shape[1]
        if more:
            rows = ((0, 0), (0, more))
            self._agent_number = np.pad(self._agent_number, rows, constant_values=NO_AGENT)
            self._from_m = np.pad(self._from_m, (*rows, (0, 0)))
            self._since = np.pad(self._since, rows)
            self._in_lane = np.pad(self._in_lane, rows)
        stays = (everyone.agent_number == self._agent_number) & (
            everyone.agent_number != NO_AGENT
        )
        stays &= np.linalg.norm(xy_m - self._from_m, axis=-1) < AWAY_M
        self._agent_number = everyone.agent_number.copy()
        self._from_m = np.where(stays[..., None], self._from_m, xy_m)
        self._since = np.where(stays, self._since, token)
        self._in_lane &= stays

    def _are_in_lane(
        self, pose: Float32[np.ndarray, "agent 3"], rollout: Int64[np.ndarray, " agent"]
    ) -> Bool[np.ndarray, " agent"]:
        """Tell which vehicles stand in a lane of their heading."""
        found = np.zeros(len(pose), dtype=bool)
        for at, (start_m, along_m) in enumerate(self._lanes):
            way_rad = np.arctan2(along_m[:, 1], along_m[:, 0])
            reach_m = np.linalg.norm(along_m, axis=1) + IN_LANE_M
            for row in np.flatnonzero(self._scene[rollout] == at):
                turned_rad = np.abs(wrap_angle(way_rad - pose[row, 2]))
                near = np.abs(start_m[:, :2] - pose[row, :2]).max(axis=1) < reach_m
                own = near & (turned_rad < ALONG_RAD)
                xyz_m = np.append(pose[row, :2], np.float32(0))[None]
                gap_m = lanes_distance_m(xyz_m, start_m[own], along_m[own])
                found[row] = gap_m[0] < IN_LANE_M
        return found

    def _wait(
        self,
        pose: Float32[np.ndarray, "agent 3"],
        rollout: Int64[np.ndarray, " agent"],
        token: int,
    ) -> Bool[np.ndarray, " agent"]:
        """Tell which vehicles have a red or yellow signal ahead."""
        device = self._lines.pose.device
        scene = torch.from_numpy(self._scene[rollout]).to(device)
        shown = self._lines.shown_ahead(
            torch.from_numpy(pose).to(device),
            scene,
            torch.from_numpy(token - self._begun[rollout]).to(device),
            WAITS_M,
        )
        return shown[:, list(RED)].any(dim=1).cpu().numpy()
