"""The closed loop, one token step at a time, for a batch of rollouts.

::

    session = Session(simulator, start)
    while planning:
        frame = session.step(ego_pose)      # or session.step(): the network drives

The order within a token step is that of SPEC 12.2: every agent moves, removed agents are
marked, and agents are inserted one by one until the network samples BEGIN MOTION.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float32

from infgen.clock import CLOCK
from infgen.geometry import wrap_angle
from infgen.model.batching.batch import MapTokens, collate_maps, to_device
from infgen.model.signal_features import StopLines
from infgen.model.step_memory import StepMemory
from infgen.model.token_step import MotionStep
from infgen.rollout.insertion import InsertionRequest, insert_agents
from infgen.rollout.insertion_mask import make_insertion_mask
from infgen.rollout.motion_sampler import Choices, MotionSampler
from infgen.rollout.population import (
    EGO_ROW,
    Population,
    advance_agents,
    place_logged_agents,
    remove_beyond,
)
from infgen.rollout.random_streams import Streams
from infgen.rollout.recording import NOBODY, Frame, RolloutStart, number_maps
from infgen.rollout.rules.density import DensityControl
from infgen.rollout.rules.rejection import make_motion_check
from infgen.rollout.rules.stalls import StallRule
from infgen.rollout.simulator import Simulator
from infgen.tokens.motion_tokens import follow, make_match_table
from infgen.tokens.scene_tokens import Presence


class Session:
    """A batch of running rollouts; a caller may drive their egos.

    A rollout depends on its own scene, index, seed and ego poses only, never on the other
    rollouts of the batch (up to rounding in the sums of the network).

    Attributes:
        population: All agents at the end of the last token step.
        token: Index of that token step.
    """

    @torch.inference_mode()
    def __init__(
        self, simulator: Simulator, starts: RolloutStart | Sequence[RolloutStart]
    ) -> None:
        """Feed the history to the network.

        Args:
            simulator: Network and settings.
            starts: Scenes to continue; several rollouts of one scene share its map.
        """
        starts = [starts] if isinstance(starts, RolloutStart) else list(starts)
        self._simulator = simulator
        self._streams = Streams.of(
            (start.seed, start.scene.scenario_id, start.index) for start in starts
        )
        history = place_logged_agents(starts, simulator.settings.max_agents)
        roads = _collate_maps(starts)
        self._memory, self._asking = _start(
            simulator, roads, starts, self._streams, history[0]
        )
        self._density = _make_density_control(simulator, starts, history[-1])
        for population in history[:-1]:
            self._ask_motion(population)
        self.population = history[-1]
        self.token = starts[0].history.now
        self._table = make_match_table(simulator.vocabulary)
        self._sampler = MotionSampler(
            simulator,
            self._streams,
            make_motion_check(
                starts,
                simulator.vocabulary,
                reject_off_road=simulator.settings.reject_off_road,
            ),
            _make_stall_rule(simulator, roads, starts),
            simulator.tensor(simulator.vocabulary.stationary),
        )
        self._driven_to: np.ndarray | None = None
        self._ego_from = self.population.pose[:, EGO_ROW]

    @property
    def ego_pose(self) -> Float32[np.ndarray, "rollout 3"]:
        """Pose of the ego of each rollout: x, y, heading in the frame of the scene."""
        if self._driven_to is not None:
            return self._driven_to
        return self.population.pose[:, EGO_ROW]

    @torch.inference_mode()
    def step(self, ego_pose: Float32[np.ndarray, "*steps 3"] | None = None) -> Frame:
        """Simulate the next token step; other agents react to the ego one token step later.

        Args:
            ego_pose: Pose of the ego in the frame of the scene: at the end of the token
                step [3], or at each of its five steps [5, 3]; with a first dimension of
                rollouts for a batch. The network sees the motion tokens that follow these
                poses most closely; each corrects the error of the one before. None lets
                the network drive the ego.
        """
        simulator, token = self._simulator, self.token + 1
        path = None if ego_pose is None else self._ego_path(ego_pose)
        before = self._drive_ego(path)
        self._ego_from = before.pose[:, EGO_ROW]
        said = self._ask_motion(before)
        choices = self._sampler.sample(before, said, token)
        moved, paths = self._move(before, choices, said, path)
        after = moved
        if simulator.inserts:
            after = insert_agents(self._query_network(moved), self._memory, moved, token)
        self.population, self.token = after, token
        self._driven_to = None if path is None else path[:, -1]
        return Frame(
            token=token,
            agent_number=moved.agent_number,
            path=paths,
            shown=self._observed_steps(before, moved, choices),
            removed=moved.presence == Presence.REMOVED,
            inserted_number=np.where(
                after.agent_number != moved.agent_number,
                after.agent_number,
                np.int32(NOBODY),
            ),
            agent_type=after.agent_type,
            size_lwh_m=after.size_lwh_m,
        )

    def correct_ego(self, ego_pose: Float32[np.ndarray, "rollout 3"]) -> None:
        """Replace the poses of the egos at the end of the last token step.

        For callers that ask for a token step before the ego has driven it: the network has
        not seen its end yet, and will see the egos exactly here, with the motion tokens
        that come closest. Motion and insertions of that token step stay as they are.

        Args:
            ego_pose: Where the egos are: x, y, heading in the frame of the scene.
        """
        agent_type = self.population.agent_type[:, EGO_ROW]
        pose, token = self.population.pose.copy(), self.population.motion_token.copy()
        token[:, EGO_ROW], _ = follow(ego_pose, self._ego_from, agent_type, self._table)
        pose[:, EGO_ROW] = ego_pose
        self.population = replace(self.population, pose=pose, motion_token=token)
        self._driven_to = None

    def _ask_motion(self, population: Population) -> MotionStep:
        """Show the network all agents; return what follows."""
        simulator, visible = self._simulator, population.visible
        return simulator.stepper.motion_step(
            self._memory, simulator.token_step(population), simulator.rows(visible)
        )

    def _query_network(self, moved: Population) -> InsertionRequest:
        """Return the insertion request, with the density wanted around the egos."""
        if self._density is None:
            return self._asking
        wanted = self._density.wanted(moved.pose[:, EGO_ROW, :2])
        return replace(self._asking, wanted=wanted)

    def _ego_path(self, ego_pose: np.ndarray) -> Float32[np.ndarray, "rollout step 3"]:
        """Return the ego poses at the five steps, interpolated if only the end is given.

        Raises:
            ValueError: if there is not one pose, or five, for each rollout.
        """
        rollouts, steps = len(self._streams), CLOCK.steps_per_token
        given = np.asarray(ego_pose, dtype=np.float32)
        given = given[None] if rollouts == 1 and given.shape[0] != 1 else given
        if given.shape == (rollouts, steps, 3):
            return given
        if given.shape != (rollouts, 3):
            raise ValueError(
                f"ego_pose has shape {ego_pose.shape}; expected ({rollouts}, 3) or "
                f"({rollouts}, {steps}, 3); the first dimension may be left out if it is 1"
            )
        begin = self.ego_pose
        way = given - begin
        way[:, 2] = wrap_angle(way[:, 2])
        share = np.arange(1, steps + 1, dtype=np.float32)[:, None] / steps
        path = begin[:, None] + share * way[:, None]
        path[..., 2] = wrap_angle(path[..., 2])
        path[:, -1] = given
        return path

    def _drive_ego(self, path: np.ndarray | None) -> Population:
        """Return the agents as the network sees them, egos at their driven poses."""
        if self._driven_to is None or path is not None:
            return self.population
        pose = self.population.pose.copy()
        pose[:, EGO_ROW] = self._driven_to
        return replace(self.population, pose=pose)

    def _move(
        self,
        before: Population,
        choices: Choices,
        said: MotionStep,
        path: np.ndarray | None,
    ) -> tuple[Population, np.ndarray]:
        """Move every agent as sampled, the egos that a caller drives along their paths."""
        simulator, settings = self._simulator, self._simulator.settings
        sampler, token = self._sampler, self.token + 1
        motion_token = sampler.release_stalled(before, said, token, choices.motion_token)
        driven = np.zeros(motion_token.shape, dtype=bool)
        if path is not None:
            target, pose = path[:, -1], before.pose[:, EGO_ROW]
            agent_type = before.agent_type[:, EGO_ROW]
            motion_token[:, EGO_ROW], _ = follow(target, pose, agent_type, self._table)
            driven[:, EGO_ROW] = True
        motion_token = sampler.reject(before, said, token, motion_token, driven)
        moved, paths = advance_agents(
            before, motion_token, choices.remove, simulator.vocabulary
        )
        if settings.removes and settings.removal_radius_m:
            moved = remove_beyond(before, moved, settings.removal_radius_m)
        if path is not None:
            paths = paths.copy()  # The population goes on from the quantised pose.
            paths[:, EGO_ROW] = path
        return moved, paths

    def _observed_steps(
        self, before: Population, moved: Population, choices: Choices
    ) -> Bool[np.ndarray, "rollout row 5"]:
        """Tell at which of the five steps each agent is observed.

        The ego is observed at all of them, an inserted agent at its first and a removed
        agent at its last, so that recorded entries and exits are exact.
        """
        steps = CLOCK.steps_per_token
        shown = np.ones((*moved.agent_number.shape, steps), dtype=bool)
        if choices.pattern is None:
            return shown
        shown &= (choices.pattern[..., None] >> np.arange(steps) & 1).astype(bool)
        shown[:, EGO_ROW] = True
        shown[..., 0] |= before.presence == Presence.INSERTED
        shown[..., -1] |= moved.presence == Presence.REMOVED
        return shown


def _collate_maps(starts: Sequence[RolloutStart]) -> MapTokens:
    """Collate the maps of the rollouts; each map once."""
    maps, _ = number_maps(starts)
    histories = [start.history for start in maps]
    return collate_maps(
        histories,
        max(history.num_map_tokens for history in histories),
        [start.lights for start in maps],
    )


def _make_stall_rule(
    simulator: Simulator, roads: MapTokens, starts: Sequence[RolloutStart]
) -> StallRule | None:
    """Return the stall rule, or None if it is off."""
    tokens = math.ceil(simulator.settings.max_stall_s / CLOCK.token_s)
    if not tokens:
        return None
    maps, scene = number_maps(starts)
    return StallRule([one.scene for one in maps], scene, StopLines.of(roads), tokens)


def _make_density_control(
    simulator: Simulator, starts: Sequence[RolloutStart], now: Population
) -> DensityControl | None:
    """Return the density control, or None if it is off."""
    if not (simulator.inserts and simulator.settings.density_control):
        return None
    return DensityControl.of(starts, now, simulator.grid.radius_m)


def _start(
    simulator: Simulator,
    roads: MapTokens,
    starts: Sequence[RolloutStart],
    streams: Streams,
    first: Population,
) -> tuple[StepMemory, InsertionRequest]:
    """Encode every map once, however many rollouts of it there are."""
    maps, scene = number_maps(starts)
    histories = [start.history for start in maps]
    # The stall rule, which runs on the host, keeps the maps that are given.
    here = to_device(roads, simulator.device)
    memory = simulator.stepper.begin(
        here, simulator.tensor(scene), first.agent_number.shape[1]
    )
    settings, insertion_mask = simulator.settings, None
    if settings.insertion_mask:
        insertion_mask = make_insertion_mask(
            histories,
            (simulator.vocabulary, simulator.roads),
            scene,
            settings.insertion_lane_distance_m,
        )
    most = np.maximum(settings.max_agents, first.num_agents)
    return memory, InsertionRequest(simulator, streams, insertion_mask, most)
