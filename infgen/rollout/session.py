"""The closed loop, one token step at a time, for a batch of rollouts.

::

    session = Session(simulator, start)
    while planning:
        frame = session.step(ego_pose)      # or session.step(): the network drives

    begun = session.begin_step(plan)        # The same in two halves, for callers that learn
    frame = session.end_step(begun, driven) # only meanwhile where the egos really go.

The order within a token step is that of SPEC 12.2: every agent moves, removed agents are
marked, and agents are inserted one by one until the network samples BEGIN MOTION.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32, Int64

from infgen.clock import CLOCK
from infgen.geometry import wrap_angle
from infgen.model.latent_rates import Rate
from infgen.model.token_step import MotionStep
from infgen.rollout.begun_step import BegunStep, logged_step
from infgen.rollout.device.insertion import DeviceInsertion
from infgen.rollout.insertion import insert_agents
from infgen.rollout.insertion_state import InsertionRequest
from infgen.rollout.maps import RolloutMaps
from infgen.rollout.motion_sampler import Choices, MotionSampler
from infgen.rollout.population import (
    EGO_ROW,
    Population,
    advance_agents,
    place_logged_agents,
    remove_beyond,
)
from infgen.rollout.random_streams import Streams
from infgen.rollout.rate_states import RateStates
from infgen.rollout.recording import NO_AGENT, Frame, RolloutStart
from infgen.rollout.rules.density import DensityControl
from infgen.rollout.simulator import Simulator
from infgen.tokens.motion_tokens import follow, make_match_table


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
        self,
        simulator: Simulator,
        starts: RolloutStart | Sequence[RolloutStart],
        maps: RolloutMaps | None = None,
    ) -> None:
        """Feed the history to the network.

        Args:
            simulator: Network and settings.
            starts: Scenes to continue; several rollouts of one scene share its map.
            maps: Their maps, if they are encoded already.
        """
        starts = [starts] if isinstance(starts, RolloutStart) else list(starts)
        self._simulator, self._starts = simulator, starts
        self._streams = Streams.of(
            (start.seed, start.scene.scenario_id, start.index) for start in starts
        )
        history = place_logged_agents(starts, simulator.settings.max_agents)
        self._maps = RolloutMaps(simulator, starts) if maps is None else maps
        scene, rows = self._maps.number(starts), history[0].agent_number.shape[1]
        self._memory = simulator.stepper.begin_on(
            self._maps.features, simulator.tensor(scene), rows
        )
        self._asking = InsertionRequest(
            simulator,
            self._streams,
            self._maps.insertion_mask(scene),
            np.maximum(simulator.settings.max_agents, history[0].num_agents),
        )
        self._device = _make_device_insertion(self._asking)
        rates = simulator.rates
        self._rates = None if rates is None else RateStates(rates, len(starts))
        self._density = _make_density_control(simulator, starts, history[-1])
        for population in history[:-1]:
            self._ask_motion(population)
        self.population = history[-1]
        self.token = starts[0].history.now
        self._table = make_match_table(simulator.vocabulary)
        self._sampler = MotionSampler(
            simulator,
            self._streams,
            self._maps.motion_check(scene),
            self._maps.stall_rule(scene),
            simulator.tensor(simulator.vocabulary.stationary),
        )
        self._driven_to: np.ndarray | None = None

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
        return self.end_step(self.begin_step(ego_pose))

    @torch.inference_mode()
    def begin_step(
        self,
        ego_pose: Float32[np.ndarray, "*steps 3"] | None = None,
        *,
        driven: bool = False,
    ) -> BegunStep:
        """Let all agents choose what they do in the next token step.

        The caller may drive the egos otherwise than it says here: others do not see where
        to before the step has ended.

        Args:
            ego_pose: Where the egos are to go, as in ``step``. None lets the network choose
                for them: it goes on from where they really are.
            driven: Whether a caller that does not know yet where the egos go will say so at
                the end. The network's choice stands in for it, on from the poses that the
                network knows of.
        """
        path = None if ego_pose is None else self._ego_path(ego_pose)
        known = self.population if driven or path is not None else self._at_driven_poses()
        return self._begin(known, path)

    @torch.inference_mode()
    def end_step(
        self,
        begun: BegunStep,
        ego_pose: Float32[np.ndarray, "*steps 3"] | None = None,
    ) -> Frame:
        """End a token step that has begun: agents are inserted.

        Args:
            begun: The token step.
            ego_pose: Where the egos went, as in ``step``; None where they were to go when
                it began.
        """
        if ego_pose is not None:
            begun = self._follow(begun, self._ego_path(ego_pose))
        return self._end(begun)

    @torch.inference_mode()
    def replace(
        self,
        begun: BegunStep,
        rollouts: Sequence[int],
        starts: Sequence[RolloutStart],
        most_maps: int = 0,
    ) -> BegunStep:
        """Let other rollouts take the place of some, in a token step that has begun.

        The token step is the last one of their histories: until it ends, their agents go
        as they were logged. After it they are as in a session of their own.

        Args:
            begun: The token step.
            rollouts: Places in the batch.
            starts: What is continued there.
            most_maps: Maps to keep encoded, beyond those that some rollout is on.

        Raises:
            ValueError: if a history is of one token step only.
        """
        at = np.array(rollouts, dtype=np.int64)
        everyone = list(self._starts)
        for place, start in zip(rollouts, starts, strict=True):
            everyone[place] = start
        self._maps.hold(everyone, most_maps)
        others = Session(self._simulator, starts, self._maps)
        rows = max(self.num_rows, others.num_rows)
        self._append_rows(rows)
        others._append_rows(rows)
        self._memory.put(self._simulator.tensor(at), others._memory)
        first = self.token + 1 - others.token
        self._streams = self._streams.put(at, others._streams, first)
        most = self._asking.most.copy()
        most[at] = others._asking.most
        if self._density is not None and others._density is not None:
            self._density = self._density.put(at, others._density)
        if self._rates is not None and others._rates is not None:
            self._rates.put(at, others._rates)
        self._starts = everyone
        self._go_to_maps(at, most)
        return begun.with_rows(rows).put(at, logged_step(starts, rows))

    @property
    def own_token(self) -> Int64[np.ndarray, " rollout"]:
        """Index of the last token step in the count of each rollout itself."""
        return self.token - self._streams.begun

    @property
    def num_rows(self) -> int:
        """Rows of each rollout."""
        return int(self.population.agent_number.shape[1])

    def _append_rows(self, rows: int) -> None:
        if rows > self.num_rows:
            self.population = self.population.with_rows(rows)
            self._memory = self._memory.with_rows(rows)

    def _go_to_maps(self, replaced: np.ndarray, most: np.ndarray) -> None:
        """Let all that knows a map know the map of each rollout."""
        maps, scene = self._maps, self._maps.number(self._starts)
        self._memory.roads = maps.features
        self._memory.scene = self._simulator.tensor(scene)
        self._asking = InsertionRequest(
            self._simulator, self._streams, maps.insertion_mask(scene), most
        )
        self._device = _make_device_insertion(self._asking)
        if self._density is not None:
            self._density = maps.density(self._density, scene)
        stall_rule = maps.stall_rule(scene)
        if stall_rule is not None and self._sampler.stall_rule is not None:
            stall_rule.go_on_from(self._sampler.stall_rule, replaced, self._streams.begun)
        self._sampler = replace(
            self._sampler,
            streams=self._streams,
            check=maps.motion_check(scene),
            stall_rule=stall_rule,
        )

    def _begin(self, before: Population, path: np.ndarray | None) -> BegunStep:
        """Let all agents move, egos along their paths if these are known."""
        said, removal_rate = self._ask_motion(before), None
        if self._rates is not None:
            self._rates.advance(self._streams, self.token + 1)
            removal_rate = self._rates.log_odds(Rate.REMOVAL)
        choices = self._sampler.sample(before, said, self.token + 1, removal_rate)
        moved, paths = self._move(before, choices, said, path)
        shown = choices.observed_steps(before, moved)
        none_gone = np.zeros(len(self._streams), dtype=bool)
        return BegunStep(before, moved, paths, shown, none_gone, path is not None)

    def _end(self, begun: BegunStep) -> Frame:
        """Insert agents, and go on to the end of the token step."""
        after = moved = begun.moved
        token = self.token + 1
        if self._simulator.inserts:
            asking = self._query_network(moved)
            if begun.is_history.any():
                most = np.where(begun.is_history, 0, asking.most)
                asking = replace(asking, most=most)
            insert = insert_agents if self._device is None else self._device.insert
            after = insert(asking, self._memory, moved, token)
        self.population, self.token = after, token
        self._driven_to = begun.path[:, EGO_ROW, -1] if begun.ego_is_driven else None
        return Frame(
            token=token,
            agent_number=moved.agent_number,
            path=begun.path,
            shown=begun.shown,
            removed=begun.removed,
            inserted_number=np.where(
                after.agent_number != moved.agent_number,
                after.agent_number,
                np.int32(NO_AGENT),
            ),
            agent_type=after.agent_type,
            size_lwh_m=after.size_lwh_m,
        )

    def _follow(self, begun: BegunStep, path: np.ndarray) -> BegunStep:
        """Replace the motion tokens of the egos by those that follow their paths."""
        before, moved, paths = begun.before, begun.moved, begun.path.copy()
        motion_token, pose = moved.motion_token.copy(), moved.pose.copy()
        motion_token[:, EGO_ROW], pose[:, EGO_ROW] = follow(
            path[:, -1], before.pose[:, EGO_ROW], before.agent_type[:, EGO_ROW], self._table
        )
        paths[:, EGO_ROW] = path
        moved = replace(moved, motion_token=motion_token, pose=pose)
        return replace(begun, moved=moved, path=paths, ego_is_driven=True)

    def _ask_motion(self, population: Population) -> MotionStep:
        """Show the network all agents; return what follows."""
        simulator, visible = self._simulator, population.visible
        return simulator.stepper.motion_step(
            self._memory, simulator.token_step(population), simulator.rows(visible)
        )

    def _query_network(self, moved: Population) -> InsertionRequest:
        """Return the insertion request, with latent rates and wanted densities."""
        asking, density, rates = self._asking, self._density, self._rates
        if density is not None:
            asking = replace(asking, wanted=density.wanted(moved.pose[:, EGO_ROW, :2]))
        if rates is not None:
            asking = replace(asking, rate=rates.log_odds(Rate.INSERTION))
        return asking

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

    def _at_driven_poses(self) -> Population:
        """Return the agents, egos exactly where they were driven."""
        if self._driven_to is None:
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


def _make_device_insertion(request: InsertionRequest) -> DeviceInsertion | None:
    """Return what inserts agents on a device; None where the host does, or nothing."""
    simulator = request.simulator
    on_host = simulator.device.type == "cpu" or not simulator.inserts
    return None if on_host else DeviceInsertion(request)


def _make_density_control(
    simulator: Simulator, starts: Sequence[RolloutStart], now: Population
) -> DensityControl | None:
    """Return the density control, or None if it is off."""
    if not (simulator.inserts and simulator.rules.density_control):
        return None
    return DensityControl.of(starts, now, simulator.grid.radius_m)
