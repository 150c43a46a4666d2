"""From a scene to its tokens: agents, insertions, map, signals and the sequence."""

from typing import Any

import numpy as np

from infgen.clock import CLOCK, Clock
from infgen.scene import Scene
from infgen.tokens.agents import match_agents
from infgen.tokens.grid import make_grid
from infgen.tokens.map import cut_map_tokens, match_map_tokens
from infgen.tokens.motion_tokens import make_match_table
from infgen.tokens.presence import has_motion, seen_tokens
from infgen.tokens.scene_tokens import Presence, SceneTokens
from infgen.tokens.sequence import encode_sequence
from infgen.tokens.settings import TokenSettings
from infgen.tokens.signals import LoggedSignals, signal_polylines, signals_at
from infgen.tokens.tracks import Paths, read_paths
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary


def tokenize_scene(
    scene: Scene,
    motion: MotionVocabulary,
    roads: MapVocabulary,
    settings: TokenSettings,
    until: int | None = None,
    clock: Clock = CLOCK,
) -> SceneTokens:
    """Tokenize a scene.

    Args:
        scene: The log.
        motion: Vocabulary of agents.
        roads: Vocabulary of the map.
        settings: Settings of the tokens.
        until: Last step to read. With ``until=scene.now`` the tokens are the history
            alone, as a simulation starts from: nothing later is read, and every agent
            observed at that step is kept, no other. (For agents however far from the ego
            set ``max_ego_distance_m`` to infinity.)
        clock: Steps and tokens.

    Raises:
        TokensError: if the scene cannot be written as tokens, saying why.
    """
    last = scene.tracks.num_steps - 1 if until is None else until
    grid = make_grid(settings)
    paths = read_paths(scene, settings, until, clock)
    paths = paths.take(_kept_agents(paths, whole_log=until is None))
    agents, insertions, anchors = match_agents(
        paths, make_match_table(motion), grid, settings.insertion_order
    )
    words = encode_sequence(agents, insertions, paths.ego)

    road_fields = _map_fields(scene, roads, last, agents.motion_token.shape[1], clock)
    return SceneTokens(
        scenario_id=scene.scenario_id,
        origin_xyz_m=scene.origin_xyz_m,
        now=clock.token_ending_at(scene.now),
        ego=paths.ego,
        track_id=paths.track_id,
        agent_type=agents.agent_type,
        size_lwh_m=paths.size_lwh_m,
        z_m=paths.z_m[:, 1:],
        pose=agents.pose,
        motion_token=agents.motion_token,
        presence=agents.presence,
        observed=agents.observed,
        pattern=np.where(agents.presence == Presence.ABSENT, np.uint8(0), paths.pattern),
        cell=agents.cell,
        near=paths.near,
        insertion_token=insertions.token,
        insertion_agent=insertions.agent,
        insertion_cell=insertions.cell,
        insertion_offset_m=insertions.offset_m,
        insertion_heading=insertions.heading,
        insertion_residual_rad=insertions.residual_rad,
        sequence_type=words.word,
        sequence_value=words.value,
        sequence_agent=words.agent,
        sequence_step=words.token,
        anchor_agent=anchors.agent,
        anchor_token=anchors.token,
        anchor_pose=anchors.pose,
        **road_fields,
    )


def read_logged_signals(scene: Scene, clock: Clock = CLOCK) -> LoggedSignals:
    """Read the signal classes of a log at all of its token steps.

    A history that is tokenized alone ends at ``now``, and its signals with it. A simulation
    may continue them as logged.
    """
    pieces, last = cut_map_tokens(scene.road_map), scene.tracks.num_steps - 1
    line, lane_id = signal_polylines(
        scene.signals, pieces.polyline, pieces.feature_id, last
    )
    ends = np.arange(clock.steps_per_token, last + 1, clock.steps_per_token)
    return LoggedSignals(line, signals_at(scene.signals, lane_id, ends))


def _map_fields(
    scene: Scene, roads: MapVocabulary, last: int, tokens: int, clock: Clock
) -> dict[str, Any]:
    """Return the map and signal fields of ``SceneTokens``."""
    pieces = cut_map_tokens(scene.road_map)
    line, lane_id = signal_polylines(
        scene.signals, pieces.polyline, pieces.feature_id, last
    )
    ends = clock.steps_per_token * np.arange(1, tokens + 1)
    lanes, lane_of = np.unique(pieces.feature_id, return_inverse=True)
    now = np.array([scene.now])
    return {
        "map_pose": pieces.pose,
        "map_z_m": pieces.z_m,
        "map_token": match_map_tokens(pieces, roads),
        "map_point_type": pieces.point_type,
        "map_polyline_type": pieces.polyline_type,
        "map_polyline": pieces.polyline,
        "map_signal": signals_at(scene.signals, lanes, now)[lane_of, 0],
        "signal_polyline": line,
        "signal_state": signals_at(scene.signals, lane_id, ends),
    }


def _kept_agents(paths: Paths, *, whole_log: bool) -> np.ndarray:
    """Return the rows of agents to tokenize: valid now (as the ego is), or with motion."""
    kept = paths.at_now
    if whole_log:
        kept = kept | has_motion(seen_tokens(paths.valid))
    return np.flatnonzero(kept)
