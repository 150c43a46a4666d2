"""Insertion of agents in one token step, with all decisions made on the device.

The rollouts of a batch go on side by side, each at a turn and an attempt of its own: one
pass asks every rollout that goes on for one position, and either inserts the agent or marks
the cell as tried. A pass has fixed shapes, masks instead of selections, and never waits: it
can be captured as a CUDA graph (``graphs``). After it the host reads once which rollouts go
on; when half of them are done the pass is made for fewer. What is inserted is what
``infgen.rollout.insertion`` inserts on a CPU, up to rounding in the sums of the network.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.batching.frames import wrap_angle
from infgen.model.neighbours import cell_pose, grid_place
from infgen.model.relations import Rows
from infgen.model.sampling import choose, sample_event
from infgen.model.step_memory import StepMemory
from infgen.model.token_step import PositionOutputs, TokenStep
from infgen.rollout.device.geometry import DeviceGrid
from infgen.rollout.device.graphs import Capture, PassGraphs, cuda_graph
from infgen.rollout.device.positions import DeviceMask
from infgen.rollout.device.random_numbers import DeviceStreams
from infgen.rollout.device.running import RunningInsertions
from infgen.rollout.insertion import INSIDE, of_type, sample_offset_and_heading
from infgen.rollout.insertion_state import TURN_PURPOSES, InsertionRequest
from infgen.rollout.population import InsertedAgents, Population, insertion_pose
from infgen.rollout.random_streams import WORDS, Purpose
from infgen.tokens.scene_tokens import EGO, FIRST_MOTION_TOKEN, Presence

LOGGED = 8
"""Numbers that are logged of an inserted agent: row, type, box, position and heading."""
FEWEST = 8
"""A pass for fewer rollouts saves nothing."""


@dataclass(frozen=True, slots=True)
class _Proposal:
    """One agent per rollout that a pass is for, to be inserted if it is allowed.

    Attributes:
        cell: Cell that was sampled.
        agent_type: ``AgentType``.
        size_lwh_m: Box.
        position_m: Position in the grid frame of the ego ...
        turned_rad: ... and heading relative to it.
        pose: Pose in the scene's frame.
    """

    cell: Int64[Tensor, " asked"]
    agent_type: Int64[Tensor, " asked"]
    size_lwh_m: Float32[Tensor, "asked 3"]
    position_m: Float32[Tensor, "asked 2"]
    turned_rad: Float32[Tensor, " asked"]
    pose: Float32[Tensor, "asked 3"]


class DeviceInsertion:
    """Inserts agents into the rollouts of a session."""

    def __init__(self, request: InsertionRequest, capture: Capture | None = None) -> None:
        """Bring what does not change between token steps to the device.

        Args:
            request: What insertion needs besides the agents.
            capture: Makes graphs of passes; as the settings say if None.
        """
        simulator, device = request.simulator, request.simulator.device
        self._simulator, mask = simulator, request.insertion_mask
        self._turns, self._attempts = simulator.settings.max_insertions, request.attempts
        self._grid = DeviceGrid(simulator.grid, device)
        self._mask = None if mask is None else DeviceMask(mask, device)
        self._streams = DeviceStreams(request.streams, device)
        shape = (self._turns, len(TURN_PURPOSES), -(-self._attempts // WORDS))
        turn, kind, block = np.indices(shape).reshape(3, -1)
        purpose = np.array(TURN_PURPOSES, dtype=np.int64)[kind]
        self._draws = [torch.from_numpy(x).to(device) for x in (block, turn, purpose)]
        if capture is None and simulator.settings.cuda_graphs and device.type == "cuda":
            capture = cuda_graph
        self._graphs = None if capture is None else PassGraphs(self._ask, capture)

    def insert(
        self,
        request: InsertionRequest,
        memory: StepMemory,
        population: Population,
        token: int,
    ) -> Population:
        """Insert agents into every rollout until the network samples BEGIN MOTION."""
        if not self._turns:
            return population
        simulator = self._simulator
        running = self._begin(memory, population, token, request)
        ask = self._ask
        if self._graphs is not None:
            running, ask = self._graphs.hold(running), self._graphs.ask
        active = np.arange(len(running.going))
        for _ in range(self._turns * self._attempts):
            asked = running.entries.rollout
            ask(running)
            going, log = simulator.fetch(running.going[asked], running.log)
            if not going.any():
                break
            kept = _kept(going)
            if len(kept) < len(active):
                active = active[kept]
                running.entries = running.entries.take(simulator.tensor(kept))
        return _inserted(population, log[:, : self._turns])

    def _begin(
        self,
        memory: StepMemory,
        population: Population,
        token: int,
        request: InsertionRequest,
    ) -> RunningInsertions:
        """Show all agents to the network, and draw the numbers of the token step."""
        simulator, grid = self._simulator, self._grid.grid
        token_step = simulator.token_step(population)
        entries = simulator.stepper.entry_begin(
            memory, token_step, simulator.rows(population.visible)
        )
        block, turn, purpose = self._draws
        drawn = self._streams.uniform(block, turn, token, purpose)
        numbers = drawn.reshape(len(drawn), self._turns, len(TURN_PURPOSES), -1)
        there = token_step.presence != int(Presence.ABSENT)
        near = self._near_ego(token_step.pose, token_step.pose[:, EGO, None]) & there
        zero = torch.zeros_like(entries.rollout)
        return RunningInsertions(
            entries=entries,
            numbers=numbers,
            going=torch.ones_like(zero, dtype=torch.bool),
            turn=zero,
            attempt=zero.clone(),
            tried=torch.zeros(
                (len(zero), grid.num_cells), dtype=torch.bool, device=zero.device
            ),
            most=simulator.tensor(request.most),
            wanted=None if request.wanted is None else simulator.tensor(request.wanted),
            add_bias=(
                simulator.settings.add_bias
                if request.rate is None
                else simulator.tensor(simulator.settings.add_bias + request.rate)
            ),
            num_agents=there.sum(dim=1),
            num_others=near[:, EGO + 1 :].sum(dim=1),
            soon=None if self._mask is None else self._mask.soon(token_step),
            log=torch.full((len(zero), self._turns + 1, LOGGED), -1.0, device=zero.device),
        )

    def _near_ego(self, pose: Tensor, ego_pose: Tensor) -> Tensor:
        """Whether poses are around egos."""
        away_m = pose[..., :2] - ego_pose[..., :2]
        return torch.hypot(away_m[..., 0], away_m[..., 1]) < self._grid.grid.radius_m

    def _ask(self, running: RunningInsertions) -> None:
        """Make one pass: ask every rollout for one position, insert where it is allowed."""
        entries, asked = running.entries, running.entries.rollout
        turn, attempt = running.turn[asked], running.attempt[asked]
        last = running.numbers.shape[-1] - 1
        numbers = running.numbers[
            asked, turn.clamp(max=self._turns - 1), :, attempt.clamp(max=last)
        ]
        query = self._simulator.stepper.entry_query(entries)
        uniform = numbers[:, TURN_PURPOSES.index(Purpose.ADD)]
        add = sample_event(query.add_logit, uniform, self._add_bias(running))
        going = running.going[asked] & (add | (attempt > 0))
        going &= running.num_agents[asked] < running.most[asked]
        proposal = self._propose(running, query, numbers)
        placed = going
        if self._mask is not None and running.soon is not None:
            placed = going & self._mask.allows(
                entries.token_step,
                running.soon,
                asked,
                proposal.pose,
                proposal.agent_type,
                proposal.size_lwh_m,
            )
        self._place(running, proposal, placed)
        tried = running.tried[asked].scatter(1, proposal.cell[:, None], True)
        running.tried.index_copy_(0, asked, tried & ~placed[:, None])
        turn, attempt = turn + placed, torch.where(placed, 0, attempt + 1)
        going &= (turn < self._turns) & (attempt < self._attempts)
        running.turn.index_copy_(0, asked, turn)
        running.attempt.index_copy_(0, asked, attempt)
        running.going.index_copy_(0, asked, going)

    def _add_bias(self, running: RunningInsertions) -> Tensor | float:
        """Return what is added to the logit of ADD, with density control."""
        asked, bias = running.entries.rollout, running.add_bias
        if isinstance(bias, Tensor):
            bias = bias[asked]
        if running.wanted is None:
            return bias
        odds = (running.wanted[asked] + 1) / (running.num_others[asked] + 1)
        return bias + self._simulator.rules.density_control * odds.log()

    def _propose(
        self, running: RunningInsertions, query: PositionOutputs, numbers: Tensor
    ) -> _Proposal:
        """Sample cell, type, size and heading for every rollout that a pass is for."""
        simulator, grid, entries = self._simulator, self._grid, running.entries

        def uniforms(purpose: Purpose) -> Tensor:
            return numbers[:, TURN_PURPOSES.index(purpose)]

        cell, position_m = self._sample_cell(running, query, uniforms(Purpose.CELL))
        details = simulator.stepper.entry_details(entries, cell, position_m)
        agent_type = choose(details.agent_type_logits, uniforms(Purpose.AGENT_TYPE))
        offset, turned_rad = sample_offset_and_heading(
            simulator, details, agent_type, uniforms
        )
        if details.turned_rad is None:
            turned_rad = grid.heading_rad[turned_rad]
        if position_m is None:
            position_m = grid.centre_m[cell]
            if offset is not None:
                offset_m = offset if details.query is None else grid.offset_m[offset]
                position_m = grid.within(position_m + offset_m, INSIDE)
        ego_pose = entries.active(entries.token_step.pose)[:, EGO]
        xy_m = cell_pose(ego_pose, position_m)[:, :2]
        heading_rad = wrap_angle(turned_rad + ego_pose[:, 2])
        return _Proposal(
            cell,
            agent_type,
            of_type(details.size_lwh_m, agent_type),
            position_m,
            turned_rad,
            torch.cat([xy_m, heading_rad[:, None]], dim=1),
        )

    def _sample_cell(
        self, running: RunningInsertions, query: PositionOutputs, uniform: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Sample cells, or take those of regressed positions, which are returned too."""
        if query.position_logits is None:
            assert query.position_m is not None
            position_m = self._grid.within(query.position_m, INSIDE)
            return self._grid.encode_cell(position_m), position_m
        settings, entries = self._simulator.settings, running.entries
        cell = entries.active(entries.token_step.cell)
        # Agents in no cell mark an extra last one.
        marked = torch.nn.functional.pad(running.tried[entries.rollout], (0, 1))
        held = torch.where(cell >= 0, cell, marked.shape[1] - 1)
        taken = marked.scatter(1, held, True)[:, :-1]
        chosen = choose(
            query.position_logits.masked_fill(taken, float("-inf")),
            uniform,
            settings.position_top_k,
            nucleus=settings.position_top_p,
            temperature=settings.position_temperature,
        )
        return chosen, None

    def _place(
        self, running: RunningInsertions, proposal: _Proposal, placed: Tensor
    ) -> None:
        """Write the agents that are placed into the first free rows of their rollouts."""
        entries, asked = running.entries, running.entries.rollout
        step = entries.token_step
        places = step.presence.shape[1]
        free = step.presence[asked] == int(Presence.ABSENT)
        row = free.to(torch.int8).argmax(dim=1)
        at = asked * places + row
        ego_pose = step.pose[asked, EGO]
        in_grid_m = grid_place(proposal.pose, ego_pose)
        new = TokenStep(
            agent_type=proposal.agent_type[None],
            size_lwh_m=proposal.size_lwh_m[None],
            pose=proposal.pose[None],
            motion_token=torch.full_like(at, FIRST_MOTION_TOKEN)[None],
            presence=torch.full_like(at, int(Presence.INSERTED))[None],
            observed=torch.zeros_like(placed)[None],
            cell=self._grid.encode_cell(in_grid_m)[None],
        )
        rows = Rows(at, step.presence)  # Nobody looks up the number of a place.
        step = step.put(at, new.where(placed[None], step.pick(at)))
        running.entries = self._simulator.stepper.entry_add(entries, step, rows, placed)
        if running.soon is not None:
            soon = running.soon.flatten(0, 1)
            pose = torch.where(placed[:, None], proposal.pose, soon[at])
            soon.index_copy_(0, at, pose)
        running.num_agents.index_add_(0, asked, placed.long())
        near = placed & self._near_ego(proposal.pose, ego_pose)
        running.num_others.index_add_(0, asked, near.long())
        told = [
            torch.stack([row, proposal.agent_type], dim=1).float(),
            proposal.size_lwh_m,
            proposal.position_m,
            proposal.turned_rad[:, None],
        ]
        slot = torch.where(placed, running.turn[asked], self._turns)
        at = asked * (self._turns + 1) + slot
        running.log.flatten(0, 1).index_copy_(0, at, torch.cat(told, dim=1))


def _kept(going: Bool[np.ndarray, " asked"]) -> Int64[np.ndarray, " kept"]:
    """Return those that the next pass is for: few different numbers of them.

    A power of two, so that a pass is captured once for each; places are filled up with
    rollouts that are done.
    """
    count = max(FEWEST, 1 << (int(going.sum()) - 1).bit_length())
    if count >= len(going):
        return np.arange(len(going))
    first = np.argsort(~going, kind="stable")[:count]
    return np.sort(first)


def _inserted(
    population: Population, log: Float32[np.ndarray, "rollout turn 8"]
) -> Population:
    """Return the population with the logged agents.

    Their poses are computed by the host, as those of all agents: to the last bit.
    """
    rollout, turn = np.nonzero(log[..., 0] >= 0)
    told = log[rollout, turn]
    agents = InsertedAgents(
        who=np.ones(len(told), dtype=bool),
        position_m=told[:, 5:7],
        turned_rad=told[:, 7],
        agent_type=told[:, 1].astype(np.int8),
        size_lwh_m=told[:, 2:5],
    )
    new, at = population.copy(), (rollout, told[:, 0].astype(np.int64))
    new.agent_number[at] = population.num_agents_so_far[rollout] + turn
    np.add.at(new.num_agents_so_far, rollout, 1)
    new.agent_type[at] = agents.agent_type
    new.size_lwh_m[at] = agents.size_lwh_m
    new.pose[at] = insertion_pose(population.pose[rollout, EGO], agents)
    new.motion_token[at] = FIRST_MOTION_TOKEN
    new.presence[at] = Presence.INSERTED
    new.observed[at] = False
    return new
