"""Tokenized scenes as padded tensors: what the network is trained on.

Dims: scene, agent, token, road, slot (turn of an inserted agent within its half second),
detail (an agent whose entry is described: an inserted agent, or one that only plays the
part). Agents are ordered from near to far by their least distance to the ego; agent 0 is
the ego. Tokens come before agents, unlike in ``SceneTokens``: what is seen together lies
together.

A batch is a function of its records, their draws and the limits: nothing is random here.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.batching.crop import (
    SceneWindow,
    cut_window,
    hide_signals,
    hide_until_near,
    perturb,
)
from infgen.model.batching.insertion_targets import (
    detail_arrays,
    insertion_arrays,
    insertion_turns,
)
from infgen.model.batching.padding import Arrays, pad
from infgen.model.batching.perturbation import Perturbation, perturb_map
from infgen.model.batching.tensors import map_tensors
from infgen.model.settings import ModelSettings
from infgen.model.training_settings import TrainSettings
from infgen.tokens.grid import make_grid
from infgen.tokens.scene_tokens import Presence, SceneTokens
from infgen.tokens.settings import TokenSettings
from infgen.tokens.signals import LoggedSignals, hold_last_signals

T = TypeVar("T")

PICKED_SHARE = 0.15
"""Share of map tokens that are hidden to be predicted: few, as everyone else does without
them in the same pass."""
FORGOTTEN_SHARE = 0.5
"""Share of scenes without signals after the history."""
BARE_RIM_SHARE = 0.5
"""Share of scenes in which nobody from beyond the rim is there from the beginning, as in a
rollout after its first seconds."""
LEFT_TOKENS = 2
"""An agent unseen for so many token steps is removed; near the end of a log it is
unknown."""


@dataclass(frozen=True, slots=True)
class Agents:
    """All agents of all scenes, as ``SceneTokens`` has them; padding is ABSENT.

    Attributes:
        agent_type: ``AgentType``.
        size_lwh_m: Boxes.
        near: Whether the agent has a motion loss.
        pose: x, y, heading at each token's end.
        motion_token: Row of the agent type's vocabulary that led here,
            ``FIRST_MOTION_TOKEN`` or ``NO_MOTION_TOKEN``.
        label: The motion token to learn for the same half second. It differs from
            ``motion_token`` only where agents are led off their ways, and then leads back.
        presence: ``Presence``.
        observed: Whether the log shows the agent throughout the token.
        pattern: Bit i: whether the log itself shows it at step i + 1 of the token.
        cell: Cell of the ego's grid, or ``NO_CELL``.
        turn: Of an agent that enters at this token, its turn among those that do; -1 for
            all others, ``OUTSIDE`` for insertions outside the grid.
        removal: Whether this is to be the agent's last token step. It differs from REMOVED
            ``presence`` only where the network removes agents.
        told: Whether that is to be learned. Near a log's end it is not known, and the ego
            never leaves.
    """

    agent_type: Int64[Tensor, "scene agent"]
    size_lwh_m: Float32[Tensor, "scene agent 3"]
    near: Bool[Tensor, "scene agent"]
    pose: Float32[Tensor, "scene token agent 3"]
    motion_token: Int64[Tensor, "scene token agent"]
    label: Int64[Tensor, "scene token agent"]
    presence: Int64[Tensor, "scene token agent"]
    observed: Bool[Tensor, "scene token agent"]
    pattern: Int64[Tensor, "scene token agent"]
    cell: Int64[Tensor, "scene token agent"]
    turn: Int64[Tensor, "scene token agent"]
    removal: Bool[Tensor, "scene token agent"]
    told: Bool[Tensor, "scene token agent"]

    @property
    def visible(self) -> Bool[Tensor, "scene token agent"]:
        """Whether others can see the agent: it is observed, or just entering."""
        return self.observed | (self.presence == int(Presence.INSERTED))


@dataclass(frozen=True, slots=True)
class MapTokens:
    """The maps of all scenes.

    Attributes:
        real: False for padding.
        pose: First point and heading.
        token: Row of the map vocabulary.
        point_type: ``PointType``.
        polyline_type: ``PolylineType``.
        signal: ``SignalClass`` at the end of the history.
        light: The traffic light of its lane, counted from 1; 0 for none.
        shown: ``SignalClass`` of those lights at the end of each token step, or
            ``REMEMBERED`` ones.
        follows: Whether the map token before it is its predecessor on the same line.
        picked: Whether it is hidden where map tokens are predicted.
    """

    real: Bool[Tensor, "scene road"]
    pose: Float32[Tensor, "scene road 3"]
    token: Int64[Tensor, "scene road"]
    point_type: Int64[Tensor, "scene road"]
    polyline_type: Int64[Tensor, "scene road"]
    signal: Int64[Tensor, "scene road"]
    light: Int64[Tensor, "scene road"]
    shown: Int64[Tensor, "scene light token"]
    follows: Bool[Tensor, "scene road"]
    picked: Bool[Tensor, "scene road"]

    @property
    def predicted(self) -> Bool[Tensor, "scene road"]:
        """Which are predicted: those hidden whose predecessor is not."""
        wanted = self.real & self.picked & self.follows
        wanted[:, 1:] &= ~self.picked[:, :-1]
        return wanted


@dataclass(frozen=True, slots=True)
class Insertions:
    """Insertion targets: which agent is inserted at which token and turn.

    Attributes:
        asked: Whether there is an insertion query at this token (never at the first, nor
            at the last of a log).
        count: Inserted agents within the grid at this token, also those beyond the last
            slot; the decisions to learn are so many and one.
        add: Whether an agent is to be inserted at each turn. Where the network inserts
            agents, that is not always known to be one that ``agent`` could name.
        agent: The agent to be inserted at each turn, or ``NO_AGENT``.
        cell: Its cell; 0 in unused slots.
    """

    asked: Bool[Tensor, "scene token"]
    count: Int64[Tensor, "scene token"]
    add: Bool[Tensor, "scene token slot"]
    agent: Int64[Tensor, "scene token slot"]
    cell: Int64[Tensor, "scene token slot"]


@dataclass(frozen=True, slots=True)
class Details:
    """Agents described at the cell they enter at.

    Attributes:
        present: False for padding.
        inserted: Whether it is truly inserted; else it is present already.
        agent: Row of the agent, hidden from its own query.
        token: When.
        turn: Inserted agents of this turn and later are hidden as well.
        cell: Where.
        agent_type: ``AgentType``.
        size_lwh_m: Its box.
        heading: Heading bin relative to the ego.
        offset_m: Position less the cell's centre, in the ego's grid frame.
        offset: Its bin.
    """

    present: Bool[Tensor, "scene detail"]
    inserted: Bool[Tensor, "scene detail"]
    agent: Int64[Tensor, "scene detail"]
    token: Int64[Tensor, "scene detail"]
    turn: Int64[Tensor, "scene detail"]
    cell: Int64[Tensor, "scene detail"]
    agent_type: Int64[Tensor, "scene detail"]
    size_lwh_m: Float32[Tensor, "scene detail 3"]
    heading: Int64[Tensor, "scene detail"]
    offset_m: Float32[Tensor, "scene detail 2"]
    offset: Int64[Tensor, "scene detail"]


@dataclass(frozen=True, slots=True)
class Batch:
    """Several scenes side by side."""

    scenario_ids: tuple[str, ...]
    agents: Agents
    roads: MapTokens
    entries: Insertions
    details: Details


@dataclass(frozen=True, slots=True)
class Limits:
    """How much of a scene a batch holds.

    Attributes:
        agents: Agents, nearest to the ego first.
        roads: Map tokens, nearest to the ego's path first.
        entries: Inserted agents per half second.
        tokens: Token steps; of a longer log a part is taken.
        grid: Settings the scenes were tokenized with.
    """

    agents: int
    roads: int
    entries: int
    tokens: int
    grid: TokenSettings

    @classmethod
    def of(
        cls, model: ModelSettings, train: TrainSettings, grid: TokenSettings
    ) -> "Limits":
        """Take the limits from the settings."""
        return cls(
            train.max_agents,
            train.max_map_tokens,
            model.max_insertions,
            train.max_token_steps,
            grid,
        )


def collate(
    records: Sequence[SceneTokens],
    limits: Limits,
    draw: int,
    noise: Perturbation | None = None,
) -> Batch:
    """Put scenes side by side.

    Args:
        records: The scenes.
        limits: How much of each is taken.
        draw: Which of the many views of a scene to take: it decides the part of a long log,
            the hidden map tokens, the pseudo-insertions and the perturbation. Equal
            draws, equal batches.
        noise: How tokens are disturbed, to learn from; None for scenes as they are.
    """
    begun = [_begin(record, limits, draw) for record in records]
    if noise and noise.moves:
        windows = [each.window for each in begun]
        chances = [each.chance for each in begun]
        strays = perturb(windows, noise, make_grid(limits.grid), chances)
        begun = [each._replace(window=w) for each, w in zip(begun, strays, strict=True)]
    scenes = [_arrays(each, limits, draw, noise) for each in begun]
    return Batch(
        scenario_ids=tuple(record.scenario_id for record in records),
        agents=pad([scene[0] for scene in scenes], Agents),
        roads=pad([scene[1] for scene in scenes], MapTokens),
        entries=pad([scene[2] for scene in scenes], Insertions),
        details=pad([scene[3] for scene in scenes], Details),
    )


def collate_maps(
    records: Sequence[SceneTokens],
    max_map_tokens: int,
    lights: Sequence[LoggedSignals | None] | None = None,
) -> MapTokens:
    """Put only the maps of scenes side by side, with nothing hidden.

    Args:
        records: The scenes.
        max_map_tokens: Map tokens of each.
        lights: What the lights of each show, if that is known for longer than the record;
            afterwards they are remembered as they were last.
    """
    maps = []
    for at, record in enumerate(records):
        window = cut_window(record, 0, record.num_tokens, record.num_agents, max_map_tokens)
        token = record.map_token[window.roads]
        arrays = _roads(window, token, np.zeros(len(token), dtype=bool))
        known = (lights[at] if lights else None) or LoggedSignals(
            record.signal_polyline, record.signal_state
        )
        tokens = known.shown.shape[1]
        arrays["light"] = _lights(record.map_polyline[window.roads], known.polyline)
        arrays["shown"] = hold_last_signals(known.shown, tokens, tokens + 1)
        maps.append(arrays)
    return _last_shown(pad(maps, MapTokens), maps)


def to_device(batch: T, device: torch.device) -> T:
    """Move every tensor of a batch, or of a part of one."""
    return map_tensors(batch, lambda x: x.to(device))


class _Begun(NamedTuple):
    """A scene of which a part is cut out, and its sources of random numbers."""

    window: SceneWindow
    random: np.random.Generator
    chance: np.random.Generator


def _begin(record: SceneTokens, limits: Limits, draw: int) -> _Begun:
    """Cut a part out of a scene."""
    random = _keyed(f"{draw}/{record.scenario_id}")
    chance = _keyed(
        f"noise/{draw}/{record.scenario_id}"
    )  # Perturbation moves no other draw.
    spare = max(0, record.num_tokens - limits.tokens)
    start = int(random.integers(spare + 1))
    window = cut_window(record, start, limits.tokens, limits.agents, limits.roads)
    if _keyed(f"rim/{draw}/{record.scenario_id}").random() < BARE_RIM_SHARE:
        window = hide_until_near(window, limits.grid, record.now + 1 - start)
    return _Begun(window, random, chance)


def _arrays(
    begun: _Begun, limits: Limits, draw: int, noise: Perturbation | None
) -> tuple[Arrays, Arrays, Arrays, Arrays]:
    """Arrays of agents, roads, entries and details of one scene."""
    window, random, chance = begun
    record, grid = window.record, make_grid(limits.grid)
    if _keyed(f"lights/{draw}/{record.scenario_id}").random() < FORGOTTEN_SHARE:
        window = hide_signals(window, record.now + 1)
    turn = insertion_turns(window)
    entries = insertion_arrays(window, turn, limits.entries)
    details = detail_arrays(window, entries, grid, random)
    picked = random.random(len(window.roads)) < PICKED_SHARE
    token = record.map_token[window.roads]
    if noise:
        token = perturb_map(token, picked, noise, chance)
    return _agents(window, turn), _roads(window, token, picked), entries, details


def _keyed(key: str) -> np.random.Generator:
    """Random numbers that a key decides."""
    digest = hashlib.sha256(key.encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, dtype=np.uint32))


def _agents(window: SceneWindow, turn: np.ndarray) -> Arrays:
    known = np.arange(len(turn.T)) + LEFT_TOKENS < len(turn.T) + window.after
    return {
        "agent_type": window.agent_type,
        "size_lwh_m": window.size_lwh_m,
        "near": window.near,
        "pose": window.pose.swapaxes(0, 1),
        "motion_token": window.motion_token.T,
        "label": window.label.T,
        "presence": window.presence.T,
        "observed": window.observed.T,
        "pattern": window.pattern.T,
        "cell": window.cell.T,
        "turn": turn.T,
        "removal": window.presence.T == Presence.REMOVED,
        "told": known[:, None] & (np.arange(len(turn)) > 0),
    }


def _roads(window: SceneWindow, token: np.ndarray, picked: np.ndarray) -> Arrays:
    record, rows = window.record, window.roads
    line = record.map_polyline[rows]
    follows = np.zeros(len(rows), dtype=bool)
    follows[1:] = (np.diff(rows) == 1) & (np.diff(line) == 0)
    return {
        "real": np.ones(len(rows), dtype=bool),
        "pose": record.map_pose[rows],
        "token": token,
        "point_type": record.map_point_type[rows],
        "polyline_type": record.map_polyline_type[rows],
        "signal": record.map_signal[rows],
        "light": _lights(line, record.signal_polyline),
        "shown": window.shown,
        "follows": follows,
        "picked": picked,
    }


def _last_shown(roads: MapTokens, maps: Sequence[Arrays]) -> MapTokens:
    """Let what a scene's lights show last go on where another scene's are known longer."""
    for row, one in enumerate(maps):
        lights, tokens = one["shown"].shape
        if lights and tokens:
            roads.shown[row, :, tokens:] = roads.shown[row, :, tokens - 1, None]
    return roads


def _lights(line: np.ndarray, signal_polyline: np.ndarray) -> np.ndarray:
    """Number of the light of each map token's line, from 1; 0 where it has none."""
    if not len(signal_polyline):
        return np.zeros(len(line), dtype=np.int64)
    at = np.minimum(np.searchsorted(signal_polyline, line), len(signal_polyline) - 1)
    return np.where(signal_polyline[at] == line, at + 1, 0)
