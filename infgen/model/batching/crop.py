"""A part of one tokenized scene: some token steps, the nearest agents and roads."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int16, Int64, UInt8

from infgen.model.batching.perturbation import (
    LoggedMotion,
    Perturbation,
    PerturbedMotion,
    perturb_scenes,
)
from infgen.tokens.grid import Grid, encode_cell, to_grid
from infgen.tokens.insertion import insertion_key
from infgen.tokens.scene_tokens import FIRST_MOTION_TOKEN, NO_CELL, Presence, SceneTokens
from infgen.tokens.settings import TokenSettings
from infgen.tokens.signals import hold_last_signals


@dataclass(frozen=True, slots=True)
class SceneWindow:
    """Part of a scene, as if the log began with it.

    Agents are ordered from near to far, the ego first. Who is there at the first token
    enters at it, as in a log that begins there.

    Attributes:
        record: The whole scene.
        after: Token steps that the log goes on for afterwards.
        label: The motion token to learn for each token: ``motion_token`` until agents are
            led astray.
        off: Where they have been: not at the pose that the log has.
        roads: Rows of the record's map tokens that are kept, ascending.
        shown: ``SignalClass`` of each of the record's lights at each token's end, or what
            it showed when it was last looked at, ``REMEMBERED``.
        agent_type, size_lwh_m, near, pose, motion_token, presence, observed, pattern, cell:
            As in the record.
        entry_row: Row of each inserted agent whose agent is kept ...
        insertion_token: ... its token, ascending from 0 ...
        insertion_cell: ... and its cell.
    """

    record: SceneTokens
    after: int
    roads: Int64[np.ndarray, " road"]
    shown: Int8[np.ndarray, "light token"]
    agent_type: Int8[np.ndarray, " agent"]
    size_lwh_m: Float32[np.ndarray, "agent 3"]
    near: Bool[np.ndarray, " agent"]
    pose: Float32[np.ndarray, "agent token 3"]
    motion_token: Int16[np.ndarray, "agent token"]
    label: Int16[np.ndarray, "agent token"]
    presence: Int8[np.ndarray, "agent token"]
    observed: Bool[np.ndarray, "agent token"]
    off: Bool[np.ndarray, "agent token"]
    pattern: UInt8[np.ndarray, "agent token"]
    cell: Int16[np.ndarray, "agent token"]
    entry_row: Int64[np.ndarray, " entry"]
    insertion_token: Int64[np.ndarray, " entry"]
    insertion_cell: Int16[np.ndarray, " entry"]


def cut_window(
    record: SceneTokens, start: int, tokens: int, max_agents: int, max_map_tokens: int
) -> SceneWindow:
    """Take ``tokens`` token steps from ``start`` on, and what is nearest to the ego."""
    stop = min(start + tokens, record.num_tokens)
    presence, observed, motion_token = _begin_at(record, start, stop)
    visible = observed | (presence == Presence.INSERTED)
    pose, pattern = record.pose[:, start:stop], record.pattern[:, start:stop]
    rows = _nearest_agents(pose, visible, record.ego)[:max_agents]
    roads = _nearest_map_tokens(record.map_pose, pose[record.ego], max_map_tokens)

    row_of = np.full(record.num_agents, -1, dtype=np.int64)
    row_of[rows] = np.arange(len(rows))
    insertion_token = record.insertion_token.astype(np.int64) - start
    kept = (row_of[record.insertion_agent] >= 0) & (insertion_token >= 0)
    kept &= insertion_token < stop - start
    return SceneWindow(
        record=record,
        after=record.num_tokens - stop,
        roads=roads,
        shown=record.signal_state[:, start:stop],
        agent_type=record.agent_type[rows],
        size_lwh_m=record.size_lwh_m[rows],
        near=record.near[rows],
        pose=pose[rows],
        motion_token=motion_token[rows],
        label=motion_token[rows],
        presence=presence[rows],
        observed=observed[rows],
        off=np.zeros_like(observed[rows]),
        pattern=np.where(presence == Presence.ABSENT, np.uint8(0), pattern)[rows],
        cell=record.cell[rows, start:stop],
        entry_row=row_of[record.insertion_agent[kept]],
        insertion_token=insertion_token[kept],
        insertion_cell=record.insertion_cell[kept],
    )


def perturb(
    windows: Sequence[SceneWindow],
    noise: Perturbation,
    grid: Grid,
    randoms: Sequence[np.random.Generator],
) -> list[SceneWindow]:
    """Lead agents astray, the ego like all others.

    Who is absent, entering or not observed is where it was. Cells follow the poses, the
    ego's too; but an inserted agent is lost to none for it, and none is won.

    Args:
        windows: Scenes; none depends on another.
        noise: How to draw.
        grid: Cells.
        randoms: Of each scene, the source of its draws.
    """
    logged = [
        LoggedMotion.drawn(
            *(window.agent_type, window.pose, window.motion_token, window.observed),
            noise,
            random,
        )
        for window, random in zip(windows, randoms, strict=True)
    ]
    found = perturb_scenes(logged, noise)
    return [_astray(*each, grid) for each in zip(windows, found, strict=True)]


def _astray(window: SceneWindow, strays: PerturbedMotion, grid: Grid) -> SceneWindow:
    cell = encode_cell(to_grid(strays.pose[..., :2], strays.pose[0]), grid)
    entering = window.presence == Presence.INSERTED
    kept = entering & ((cell == NO_CELL) | (window.cell == NO_CELL))
    told = (window.observed | entering) & (strays.off | strays.off[0]) & ~kept
    cell = np.where(told, cell, window.cell)
    return replace(
        window,
        pose=strays.pose,
        motion_token=strays.motion_token,
        label=strays.label,
        off=strays.off,
        cell=cell,
        insertion_cell=cell[window.entry_row, window.insertion_token],
    )


def hide_until_near(
    window: SceneWindow, settings: TokenSettings, known: int
) -> SceneWindow:
    """Hide agents that begin beyond ``insertion_distance_m`` until they come within.

    They are inserted then; agents that never come within are dropped.

    Args:
        window: What is known.
        settings: The distance (0 hides no agent), and the insertion order.
        known: Token steps of the history.
    """
    if not settings.insertion_distance_m or known < 1:
        return window
    away_m = window.pose[..., :2] - window.pose[0, :, :2]
    visible = window.observed | (window.presence == Presence.INSERTED)
    inside = np.hypot(away_m[..., 0], away_m[..., 1]) < settings.insertion_distance_m
    inside &= visible
    born = visible.argmax(axis=1)
    # Agents present when the history ends are seen from the next token step at latest.
    far = (born <= known) & ~inside[np.arange(len(inside)), born]
    far[0] = False

    came = np.zeros_like(inside)
    came[:, 1:] = np.logical_or.accumulate(inside, axis=1)[:, :-1]
    presence, observed, motion_token = _enter_late(
        (window.presence, window.observed, window.motion_token), far, window.observed & came
    )
    changed = replace(
        window,
        presence=presence,
        observed=observed,
        motion_token=motion_token,
        label=motion_token,
        pattern=np.where(presence == Presence.ABSENT, np.uint8(0), window.pattern),
    )
    return _with_entries(changed, far, settings.insertion_order)


def hide_signals(window: SceneWindow, known: int) -> SceneWindow:
    """Hide signals after the first ``known`` token steps."""
    tokens = window.shown.shape[1]
    return replace(
        window, shown=hold_last_signals(window.shown, min(known, tokens), tokens)
    )


def _begin_at(
    record: SceneTokens, start: int, stop: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Presence, observed and move of the window, everyone entering at its first token.

    Who is not observed then enters when it is next observed. Who leaves at the first token
    has no second one and is dropped.
    """
    presence = record.presence[:, start:stop]
    observed = record.observed[:, start:stop]
    motion_token = record.motion_token[:, start:stop]
    if start == 0:
        return presence, observed, motion_token
    before = record.presence[:, start - 1]
    running = np.isin(before, (Presence.PRESENT, Presence.INSERTED))
    return _enter_late((presence, observed, motion_token), running, observed)


def _enter_late(
    life: tuple[np.ndarray, np.ndarray, np.ndarray], who: np.ndarray, able: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Presence, observed and move of agents of whom some enter as soon as they are able.

    Who never is, or is to leave then, is not there at all: it would have no second token.
    """
    presence, observed, motion_token = (values.copy() for values in life)
    columns = np.arange(presence.shape[1])
    first = np.where(able.any(axis=1), able.argmax(axis=1), len(columns))
    leaves = presence[np.arange(len(first)), first.clip(max=len(columns) - 1)]
    gone = who & ((first == len(columns)) | (leaves == Presence.REMOVED))

    unseen = who[:, None] & (columns < first[:, None]) | gone[:, None]
    presence[unseen], observed[unseen] = Presence.ABSENT, False
    enters = (who & ~gone)[:, None] & (columns == first[:, None])
    presence[enters], observed[enters], motion_token[enters] = (
        Presence.INSERTED,
        False,
        FIRST_MOTION_TOKEN,
    )
    return presence, observed, motion_token


def _with_entries(window: SceneWindow, who: np.ndarray, order: str) -> SceneWindow:
    """List the entries of some agents anew, among those of all others."""
    row, token = np.nonzero((window.presence == Presence.INSERTED) & who[:, None])
    kept = ~who[window.entry_row]
    row = np.concatenate([window.entry_row[kept], row])
    token = np.concatenate([window.insertion_token[kept], token])
    key = insertion_key(window.pose[row, token], window.pose[0, token], order)
    sorted_ = np.lexsort((key, token))
    row, token = row[sorted_], token[sorted_]
    return replace(
        window, entry_row=row, insertion_token=token, insertion_cell=window.cell[row, token]
    )


def _nearest_agents(pose: np.ndarray, visible: np.ndarray, ego: int) -> np.ndarray:
    """Rows of the agents that are there, by least distance to the ego, the ego first."""
    away_m = pose[..., :2] - pose[ego, :, :2]
    together = visible & visible[ego]
    distance_m = np.where(together, np.hypot(away_m[..., 0], away_m[..., 1]), np.inf)
    distance_m = distance_m.min(axis=1, initial=np.inf)
    distance_m[ego] = -1.0
    order = np.argsort(distance_m, kind="stable")
    return order[visible[order].any(axis=1) | (order == ego)]


def _nearest_map_tokens(map_pose: np.ndarray, path: np.ndarray, limit: int) -> np.ndarray:
    """Rows, ascending, of the map tokens nearest to the ego's path."""
    if len(map_pose) <= limit:
        return np.arange(len(map_pose))
    away_m = map_pose[:, None, :2] - path[:, :2]  # [road, token, 2]
    distance_m2 = (away_m**2).sum(axis=-1).min(axis=1)
    return np.sort(np.argsort(distance_m2, kind="stable")[:limit])
