"""Coverage of the two vocabularies on held-out scenes, and their contents.

Motion tokens are matched as in tokenization, rolling forward, so the error is that of
tokens.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int64

from infgen.clock import CLOCK
from infgen.scene import AgentType
from infgen.tokens.agents import match_agents
from infgen.tokens.clustering.kdisks import Items, Space, mean_gap_m
from infgen.tokens.clustering.motion_samples import NUM_AGENT_TYPES
from infgen.tokens.clustering.physical_limits import keeps_limits, motion_limits
from infgen.tokens.clustering.settings import VocabSettings
from infgen.tokens.clustering.vocabularies import MapSpace, MotionSpace, Origin
from infgen.tokens.grid import make_grid
from infgen.tokens.map import nearest_map_tokens
from infgen.tokens.motion_tokens import make_match_table
from infgen.tokens.settings import TokenSettings
from infgen.tokens.tracks import Paths
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary

MOVING_M = 0.05
"""A motion token whose end is nearer than this to its start does not count as moving."""
STRAIGHT_DEG = 0.1
"""What turns less is counted neither as left nor as right."""


@dataclass(frozen=True, slots=True)
class Matches:
    """Every observed token of some scenes, matched.

    Attributes:
        agent_type: ``AgentType`` of the agent.
        motion_token: The motion token chosen.
        error_m: From the centre where the chain of motion tokens is to the logged centre.
    """

    agent_type: Int8[np.ndarray, " match"]
    motion_token: Int64[np.ndarray, " match"]
    error_m: Float64[np.ndarray, " match"]


def match_paths(paths: Iterable[Paths], vocabulary: MotionVocabulary) -> Matches:
    """Match the agents of scenes as the tokenizer does."""
    settings = TokenSettings()
    table, grid = make_match_table(vocabulary), make_grid(settings)
    agent_types, motion_tokens, errors_m = (
        [np.empty(0, np.int8)],
        [np.empty(0, int)],
        [np.empty(0)],
    )
    for scene in paths:
        agents = match_agents(scene, table, grid, settings.insertion_order)[0]
        away_m = agents.pose[..., :2].astype(np.float64) - scene.pose[:, 1:, :2]
        row, token = np.nonzero(agents.observed)
        agent_types.append(agents.agent_type[row])
        motion_tokens.append(agents.motion_token[row, token].astype(int))
        errors_m.append(np.hypot(*away_m[row, token].T))
    return Matches(
        np.concatenate(agent_types), np.concatenate(motion_tokens), np.concatenate(errors_m)
    )


def describe_motion(
    vocabulary: MotionVocabulary,
    origin: Int8[np.ndarray, "3 motion"],
    held_out: Matches,
    familiar: Matches,
    settings: VocabSettings,
) -> dict[str, Any]:
    """Describe the motion tokens of each agent type and their error on held-out scenes.

    Args:
        vocabulary: The motion tokens.
        origin: ``Origin`` of each.
        held_out: Matches of scenes the vocabulary was not made from.
        familiar: Matches of scenes it was made from; they count only as use.
        settings: What the vocabulary was made with.
    """
    return {
        AgentType(agent_type).name.lower(): {
            **_origins(origin[agent_type]),
            **_use(agent_type, vocabulary.num_motion_tokens, held_out, familiar),
            "held_out_error_m": _spread(
                held_out.error_m[held_out.agent_type == agent_type]
            ),
            "held_out_error_moving_m": _spread(
                _moving_error(vocabulary, held_out, agent_type)
            ),
            **_describe_shapes(
                MotionSpace(agent_type, motion_limits(settings)),
                vocabulary.path[agent_type],
                np.array([1, -1, -1], dtype=np.float32),
            ),
            **_describe_kinematics(vocabulary.path[agent_type], agent_type, settings),
        }
        for agent_type in range(NUM_AGENT_TYPES)
    }


def describe_map(
    vocabulary: MapVocabulary,
    origin: Int8[np.ndarray, " map_token"],
    held_out_m: Float32[np.ndarray, "unknown 11 2"],
    familiar_m: Float32[np.ndarray, "known 11 2"],
) -> dict[str, Any]:
    """Describe the shapes of map tokens and their error on held-out polylines."""
    space = MapSpace()
    chosen = nearest_map_tokens(held_out_m, vocabulary)
    used = np.union1d(chosen, nearest_map_tokens(familiar_m, vocabulary))
    steps_m = np.diff(vocabulary.curve_m.astype(np.float64), axis=1)
    heading_rad = np.arctan2(steps_m[..., 1], steps_m[..., 0])
    turn_deg = np.degrees(np.unwrap(heading_rad, axis=1)[:, -1])
    return {
        **_origins(origin),
        "dead": vocabulary.num_map_tokens - len(used),
        "held_out_pieces": len(held_out_m),
        "held_out_error_m": _spread(_map_error_m(held_out_m, vocabulary, chosen)),
        **_describe_shapes(space, vocabulary.curve_m, np.array([1, -1], dtype=np.float32)),
        "length_m": _range(np.linalg.norm(steps_m, axis=-1).sum(axis=-1)),
        **_turns(turn_deg),
    }


def describe_source(
    matches: Matches, vocabulary: MapVocabulary, curve_m: Float32[np.ndarray, "piece 11 2"]
) -> dict[str, dict[str, Any] | None]:
    """Describe how far tokens are from the scenes of one source.

    Args:
        matches: Of its motion tokens.
        vocabulary: The map tokens.
        curve_m: Pieces of its map lines.

    Returns:
        Number, mean and 95th percentile of errors, by agent type and for map tokens; None
        where there are none.
    """
    chosen = nearest_map_tokens(curve_m, vocabulary)
    by_type = {
        AgentType(agent_type).name.lower(): matches.error_m[
            matches.agent_type == agent_type
        ]
        for agent_type in range(NUM_AGENT_TYPES)
    }
    errors_m = {**by_type, "map": _map_error_m(curve_m, vocabulary, chosen)}
    return {name: _error(values) for name, values in errors_m.items()}


def _map_error_m(
    curve_m: np.ndarray, vocabulary: MapVocabulary, chosen: np.ndarray
) -> Float64[np.ndarray, " piece"]:
    """Mean distance of middle and last point of each piece from those of its token."""
    space = MapSpace()
    away_m = space.points_m(curve_m) - space.points_m(vocabulary.curve_m[chosen])
    return np.linalg.norm(away_m, axis=-1).mean(axis=-1).astype(np.float64)


def _error(values: np.ndarray) -> dict[str, Any] | None:
    if len(values) == 0:
        return None
    figures = {"mean": values.mean(), "p95": np.percentile(values, 95)}
    rounded = {name: round(float(value), 5) for name, value in figures.items()}
    return {"count": len(values), **rounded}


def _origins(origin: np.ndarray) -> dict[str, int]:
    names = {Origin.LOGGED: "real", Origin.MIRRORED: "mirrored", Origin.MADE: "made"}
    return {name: int((origin == value).sum()) for value, name in names.items()}


def _use(
    agent_type: int, num_motion_tokens: int, held_out: Matches, familiar: Matches
) -> dict[str, int]:
    parts = [
        matches.motion_token[matches.agent_type == agent_type]
        for matches in (held_out, familiar)
    ]
    used = len(np.unique(np.concatenate(parts)))
    return {"dead": num_motion_tokens - used, "held_out_tokens": len(parts[0])}


def _moving_error(
    vocabulary: MotionVocabulary, matches: Matches, agent_type: int
) -> np.ndarray:
    end_m = np.hypot(*vocabulary.end_pose[agent_type, :, :2].T)
    moving = (matches.agent_type == agent_type) & (end_m[matches.motion_token] > MOVING_M)
    return matches.error_m[moving]


def _describe_shapes(space: Space, items: Items, mirror: np.ndarray) -> dict[str, Any]:
    """Measure how close rows are to each other, and to mirror images of others."""
    points_m, mirrored_m = space.points_m(items), space.points_m(items * mirror)
    gaps_m = np.array([np.partition(mean_gap_m(points_m, one), 1)[1] for one in points_m])
    mirror_m = np.array([mean_gap_m(points_m, one).min() for one in mirrored_m])
    return {"nearest_gap_m": _range(gaps_m), "mirror_gap_m": _range(mirror_m)}


def _describe_kinematics(
    path: np.ndarray, agent_type: int, settings: VocabSettings
) -> dict[str, Any]:
    end = path[:, -1].astype(np.float64)
    speed_mps = np.hypot(end[:, 0], end[:, 1]) * np.sign(end[:, 0]) / CLOCK.token_s
    beyond = ~keeps_limits(path, agent_type, motion_limits(settings))
    return {
        "speed_mps": _range(speed_mps),
        **_turns(np.degrees(end[:, 2])),
        "beyond_limits": int(beyond.sum()),
    }


def _turns(turn_deg: np.ndarray) -> dict[str, Any]:
    """Say how far rows turn, and how many turn to either side."""
    return {
        "turn_deg": _range(turn_deg),
        "left": int((turn_deg > STRAIGHT_DEG).sum()),
        "right": int((turn_deg < -STRAIGHT_DEG).sum()),
    }


def _spread(values: np.ndarray) -> dict[str, float] | None:
    """Return mean, median and worst cases; None where there is nothing to measure."""
    if len(values) == 0:
        return None
    p50, p99 = np.percentile(values, [50, 99])
    figures = {"mean": values.mean(), "p50": p50, "p99": p99, "max": values.max()}
    return {name: round(float(value), 5) for name, value in figures.items()}


def _range(values: np.ndarray) -> dict[str, float]:
    low, p50, high = np.percentile(values, [0, 50, 100])
    figures = {"min": low, "p50": p50, "max": high}
    return {name: round(float(value), 4) for name, value in figures.items()}
