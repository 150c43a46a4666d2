"""Small made-up tokenized scenes, and a network small enough to check number by number."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.config import ModelSettings, TokenSettings
from infgen.geometry import to_world
from infgen.model.batching.batch import Limits, MapTokens
from infgen.model.features.polyline_segments import road_edges
from infgen.model.network import Network
from infgen.tokens.grid import encode_cell, encode_heading, make_grid, to_grid
from infgen.tokens.map import PolylineType
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
    SceneTokens,
    SignalClass,
)
from infgen.tokens.vocabulary import BOX_LW_M, MapVocabulary, MotionVocabulary

NUM_MOVES, NUM_ROADS = 24, 12
GRID = TokenSettings(grid_radius_m=60.0, grid_cell_m=4.0, heading_bin_deg=10.0)
TINY = ModelSettings(
    width=16,
    heads=2,
    map_blocks=2,
    motion_blocks=2,
    scene_blocks=2,
    fourier_bands=4,
    dropout=0.0,
    temporal_window_tokens=4,
    map_map_neighbours=8,
    map_agent_neighbours=16,
    agent_agent_neighbours=6,
    position_query_map_neighbours=24,
    heading_query_map_neighbours=8,
    heading_query_agent_neighbours=4,
    max_insertions=3,
    map_agent_lookahead_m=4.0,
    map_agent_lateral_offset=True,
    cell_feature_width=6,
    motion_feature_width=10,
    ego_embedding=True,
    signals_each_step=True,
    signal_ahead_m=15.0,
)

VARIANTS = {
    "full": {},
    "smart": {"insertion_and_removal": False},
    "no leave token": {"remove_token": False},
    "no cell token": {"position_token": False},
    "no heading token": {"heading_token": False},
    "no leave, no cell token": {"remove_token": False, "position_token": False},
    "patterns": {"validity_pattern_tokens": True},
    "the paper's": {
        "cell_feature_width": 0,
        "motion_feature_width": 0,
        "ego_embedding": False,
        "signals_each_step": False,
        "signal_ahead_m": 0.0,
        "map_agent_lookahead_m": 0.0,
        "map_agent_lateral_offset": False,
    },
    "narrow relations": {"relation_width": 6},
    "rotary": {"relations": "rotary", "map_agent_lateral_offset": False},
    "offset token": {"offset_token": True},
    "offset token, the paper's features": {"offset_token": True, "cell_feature_width": 0},
    "long memory": {"density_features": True, "standing_features": True},
    "ego features": {"ego_features": True, "standing_features": True},
    "cell refinement": {"cell_refinement_width": 8},
    "agent spacing": {"agent_spacing_width": 4, "offset_token": True},
    "placement features": {"placement_features": True, "offset_token": True},
    "removal features": {"removal_features": True},
    "latent rates": {"latent_rates": True},
    "approach features": {"approach_features": True},
    "over edge": {"over_edge_head": True},
    "last move": {"last_move_head": True, "motion_feature_width": 8},
    "clearance": {"clearance_width": 8, "edge_clearance_width": 8},
    "smart with patterns": {
        "insertion_and_removal": False,
        "validity_pattern_tokens": True,
    },
}
"""Baselines and ablations of SPEC 7, and heads that are off by default."""


def make_motion_codebook(num_motion_tokens=NUM_MOVES):
    random = np.random.default_rng(0)
    end = random.uniform([0, -0.5, -0.3], [5, 0.5, 0.3], size=(3, num_motion_tokens, 3))
    end[:, 0] = 0
    path = end[:, :, None] * np.linspace(0, 1, 6)[:, None]
    real = np.ones((3, num_motion_tokens), dtype=bool)
    return MotionVocabulary(BOX_LW_M, path.astype(np.float32), real)


def make_road_codebook(num_map_tokens=NUM_ROADS):
    bend = np.linspace(-0.1, 0.1, num_map_tokens)[:, None] * np.arange(11)
    steps = 0.5 * np.stack([np.cos(bend), np.sin(bend)], axis=-1)
    curve = np.concatenate(
        [np.zeros((num_map_tokens, 1, 2)), steps.cumsum(axis=1)[:, :10]], 1
    )
    return MapVocabulary(curve.astype(np.float32), np.ones(num_map_tokens, dtype=bool))


def make_record(
    seed=0, agents=9, tokens=7, roads=60, lives=None, kinds=(0, 1, 2), spread_m=40.0
):
    """A scene of random moves. ``lives`` are (first, last) tokens of rows 1, 2, ...

    By default a third is there throughout, a third enters and a third leaves.
    """
    random = np.random.default_rng(seed)
    if lives is None:
        lives = [_life(random, tokens) for _ in range(agents - 1)]
    lives = [(0, tokens - 1), *lives]
    agents = len(lives)
    vocabulary = make_motion_codebook()
    agent_type = np.array([0, *random.choice(kinds, agents - 1)], dtype=np.int8)
    motion_token = random.integers(vocabulary.num_motion_tokens, size=(agents, tokens))
    start = random.uniform(-1, 1, size=(agents, 3)) * [spread_m, spread_m, np.pi]
    start[0] = [0, 0, 0.4]
    pose = [start.astype(np.float32)]
    for token in range(1, tokens):
        ends = vocabulary.end_pose[agent_type, motion_token[:, token]]
        pose.append(to_world(ends, pose[-1]))
    pose = np.stack(pose, axis=1).astype(np.float32)

    presence = np.zeros((agents, tokens), dtype=np.int8)
    for row, (first, last) in enumerate(lives):
        presence[row, first : last + 1] = Presence.PRESENT
        presence[row, first] = Presence.INSERTED
        if last < tokens - 1:
            presence[row, last] = Presence.REMOVED
    return _record(f"scene-{seed}", agent_type, pose, motion_token, presence, roads, random)


def _life(random, tokens):
    what = random.integers(3) if tokens > 3 else 0
    if what == 0:
        return 0, tokens - 1
    if what == 1:
        return int(random.integers(1, tokens - 1)), tokens - 1
    return 0, int(random.integers(1, tokens - 1))


def _record(name, agent_type, pose, motion_token, presence, roads, random):
    agents, tokens = presence.shape
    grid = make_grid(GRID)
    entering = presence == Presence.INSERTED
    absent = presence == Presence.ABSENT
    observed = ~absent & ~entering
    motion_token = np.where(
        absent, NO_MOTION_TOKEN, np.where(entering, FIRST_MOTION_TOKEN, motion_token)
    )
    pose = np.where(absent[..., None], 0, pose).astype(np.float32)
    in_grid_m = to_grid(pose[..., :2], pose[:1])
    cell = np.where(absent, NO_CELL, encode_cell(in_grid_m, grid)).astype(np.int16)

    token, row = np.nonzero(entering.T)
    far_m = np.linalg.norm(pose[row, token, :2] - pose[0, token, :2], axis=-1)
    order = np.lexsort([far_m, token])
    token, row = token[order], row[order]
    centre_m = grid.centre_m[cell[row, token]]
    offset_m = np.where(cell[row, token, None] >= 0, in_grid_m[row, token] - centre_m, 0)
    none = np.empty(0)
    line = np.arange(roads) // 6
    lit = np.unique(line)[1::3]
    map_pose = random.uniform(-1, 1, (roads, 3)) * [50, 50, np.pi]
    map_pose[np.searchsorted(line, lit)] = _somewhere_ahead(pose, observed, len(lit))
    return SceneTokens(
        scenario_id=name,
        origin_xyz_m=np.zeros(3),
        now=1,
        ego=0,
        track_id=np.arange(agents, dtype=np.int32),
        agent_type=agent_type,
        size_lwh_m=random.uniform(1, 5, size=(agents, 3)).astype(np.float32),
        z_m=np.zeros((agents, tokens), dtype=np.float32),
        pose=pose,
        motion_token=motion_token.astype(np.int16),
        presence=presence,
        observed=observed,
        pattern=np.where(absent, 0, _any_pattern(absent.shape)).astype(np.uint8),
        cell=cell,
        near=np.ones(agents, dtype=bool),
        insertion_token=token.astype(np.int16),
        insertion_agent=row.astype(np.int16),
        insertion_cell=cell[row, token],
        insertion_offset_m=offset_m.astype(np.float32),
        insertion_heading=encode_heading(pose[row, token, 2] - pose[0, token, 2], grid),
        insertion_residual_rad=np.zeros(len(row), dtype=np.float32),
        map_pose=map_pose.astype(np.float32),
        map_z_m=np.zeros(roads, dtype=np.float32),
        map_token=random.integers(NUM_ROADS, size=roads).astype(np.int16),
        map_point_type=random.integers(10, size=roads).astype(np.int8),
        map_polyline_type=random.integers(4, size=roads).astype(np.int8),
        map_polyline=line.astype(np.int32),
        map_signal=random.integers(len(SignalClass), size=roads).astype(np.int8),
        signal_polyline=lit.astype(np.int32),
        signal_state=_any_signal((len(lit), tokens)),
        sequence_type=none.astype(np.uint8),
        sequence_value=none.astype(np.int16),
        sequence_agent=none.astype(np.int16),
        sequence_step=none.astype(np.uint16),
        anchor_agent=none.astype(np.int16),
        anchor_token=none.astype(np.int16),
        anchor_pose=np.empty((0, 3), dtype=np.float32),
    )


def _somewhere_ahead(pose, observed, count):
    """Stop lines that some agent has six metres ahead at some time."""
    agent, token = np.nonzero(observed)
    if not len(agent):
        return np.zeros((count, 3), dtype=np.float32)
    some = np.linspace(0, len(agent) - 1, count).round().astype(int)
    six = np.float32([[6.0, 0.3, 0.1]])
    return to_world(np.repeat(six, count, axis=0), pose[agent[some], token[some]])


def _any_signal(shape):
    lit = np.random.default_rng(2).integers(len(SignalClass), size=shape)
    return lit.astype(np.int8)


def _any_pattern(shape):
    return np.random.default_rng(1).integers(32, size=shape)


def move_world(record, turn_rad, shift_m):
    """The same scene with its world turned about the origin and shifted."""
    frame = np.float32([*shift_m, turn_rad])
    absent = record.presence == Presence.ABSENT
    pose = to_world(record.pose, np.broadcast_to(frame, record.pose.shape))
    map_pose = to_world(record.map_pose, np.broadcast_to(frame, record.map_pose.shape))
    return replace(
        record,
        pose=np.where(absent[..., None], 0, pose).astype(np.float32),
        map_pose=map_pose.astype(np.float32),
    )


@pytest.fixture(scope="session")
def limits():
    return Limits(agents=32, roads=200, entries=TINY.max_insertions, tokens=18, grid=GRID)


def make_network(settings=TINY, seed=0):
    torch.manual_seed(seed)
    network = Network(settings, make_motion_codebook(), make_road_codebook(), GRID)
    # Biases and gains away from 0 and 1, so that tests see whether they are used.
    for parameter in network.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    return network


@pytest.fixture(scope="session")
def network():
    return make_network().eval()


@pytest.fixture(scope="module", params=VARIANTS)
def variant(request):
    """Settings of each variant in turn."""
    return replace(TINY, **VARIANTS[request.param])


@pytest.fixture(scope="session")
def record():
    return make_record


@pytest.fixture(scope="session")
def turned():
    return move_world


@pytest.fixture(scope="session")
def new_network():
    return make_network


@pytest.fixture(scope="session")
def tiny():
    return TINY


@pytest.fixture(scope="session")
def grid_settings():
    return GRID


@pytest.fixture(scope="session")
def vocabularies():
    def make(num_motion_tokens=NUM_MOVES, num_map_tokens=NUM_ROADS):
        return make_motion_codebook(num_motion_tokens), make_road_codebook(num_map_tokens)

    return make


def _lines(kind, *poses, follows=None):
    count = len(poses)
    nothing = torch.zeros((1, count), dtype=torch.int64)
    return MapTokens(
        real=torch.ones((1, count), dtype=torch.bool),
        pose=torch.tensor([poses], dtype=torch.float32).view(1, count, 3),
        token=nothing,
        point_type=nothing,
        polyline_type=torch.full((1, count), int(kind)),
        signal=nothing,
        light=nothing,
        shown=nothing[:, None],
        follows=torch.tensor([follows or [False] * count], dtype=torch.bool),
        picked=torch.zeros((1, count), dtype=torch.bool),
    )


@pytest.fixture
def lines():
    """Map tokens of one map, by polyline type and poses; ``follows`` joins them."""
    return _lines


@pytest.fixture
def edges():
    """Road edges of one map that begin at poses."""

    def found(*poses, follows=None, kind=PolylineType.ROAD_EDGE):
        return road_edges(_lines(kind, *poses, follows=follows))

    return found
