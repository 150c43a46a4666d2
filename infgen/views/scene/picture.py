"""Pictures of scenes and rollouts: roads by kind, agents as boxes that show their heading.

A picture is a strip of views of one place at several moments, each centred on where the ego
is then, x to the right and y up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Bool, Float32

from infgen.clock import CLOCK
from infgen.geometry import box_corners
from infgen.rollout.rollout import Rollout
from infgen.scene import FeatureType, RoadMap, Scene

REACH_M = 60.0
"""From the ego to the edge of a view."""
VIEW_PX = 250
_GAP_PX, _TITLE_PX, _LEGEND_PX = 8, 22, 26
_NOTCH = 0.35
"""Share of a box's length that its pointed front takes."""

EGO, INITIAL, INSERTED = "ego", "initial", "inserted"
_LEGEND = {EGO: "ego", INITIAL: "there at the start", INSERTED: "came in later"}
_LOOKS = {
    FeatureType.CROSSWALK: "zebra",
    FeatureType.SPEED_BUMP: "zebra",
    FeatureType.DRIVEWAY: "zebra",
    FeatureType.LANE: "lane",
    FeatureType.ROAD_LINE: "paint",
    FeatureType.ROAD_EDGE: "edge",
}
"""How kinds of features are drawn, from the bottom up. Stop signs are not."""


@dataclass(frozen=True, slots=True)
class _Moment:
    """Agents at one moment, and the middle of the view."""

    title: str
    pose: Float32[np.ndarray, "agent 3"]
    size_lw_m: Float32[np.ndarray, "agent 2"]
    looks: tuple[str, ...]
    centre_m: Float32[np.ndarray, "2"]


def scene_strip(scene: Scene, steps: Sequence[int]) -> str:
    """Draw a log at some steps, side by side."""
    tracks = scene.tracks
    later = np.asarray(~tracks.valid[:, : scene.now + 1].any(axis=1))
    moments = [
        _moment(
            (step - scene.now) * CLOCK.step_s,
            tracks.pose(step),
            tracks.size_lwh_m[:, step],
            tracks.valid[:, step],
            later,
            scene.ego,
        )
        for step in steps
    ]
    return _strip(f"Log of {scene.scenario_id}", scene.road_map, moments)


def rollout_strip(rollout: Rollout, road_map: RoadMap, steps: Sequence[int]) -> str:
    """Draw a rollout at some steps, side by side, on the map of its scene."""
    moments = [
        _moment(
            (step - rollout.now) * CLOCK.step_s,
            np.column_stack([rollout.xyz_m[:, step, :2], rollout.heading_rad[:, step]]),
            rollout.size_lwh_m,
            rollout.valid[:, step],
            ~rollout.logged,
            rollout.ego,
        )
        for step in steps
    ]
    return _strip(f"Rollout {rollout.index} of {rollout.scenario_id}", road_map, moments)


def _moment(
    time_s: float,
    pose: Float32[np.ndarray, "agent 3"],
    size_lwh_m: Float32[np.ndarray, "agent 3"],
    shown: Bool[np.ndarray, " agent"],
    later: Bool[np.ndarray, " agent"],
    ego: int,
) -> _Moment:
    """Keep who is there."""
    rows = np.flatnonzero(shown)
    looks = np.where(later, INSERTED, INITIAL)
    looks[ego] = EGO
    return _Moment(
        title=f"t = {time_s:g} s, {len(rows)} agents",
        pose=pose[rows],
        size_lw_m=size_lwh_m[rows, :2],
        looks=tuple(looks[rows].tolist()),
        centre_m=pose[ego, :2],
    )


def _strip(title: str, road_map: RoadMap, moments: Sequence[_Moment]) -> str:
    width = len(moments) * (VIEW_PX + _GAP_PX) - _GAP_PX
    height = _TITLE_PX + VIEW_PX + _LEGEND_PX
    views = []
    for at, moment in enumerate(moments):
        place = f'x="{at * (VIEW_PX + _GAP_PX)}" y="{_TITLE_PX}"'
        views.append(
            f'<text class="ink" x="{at * (VIEW_PX + _GAP_PX) + 4}" y="15">'
            f"{escape(moment.title)}</text>"
            f'<svg {place} width="{VIEW_PX}" height="{VIEW_PX}">'
            f'<rect class="view" width="{VIEW_PX}" height="{VIEW_PX}"/>'
            f"{_roads(road_map, moment.centre_m)}{_agents(moment)}</svg>"
        )
    return (
        f'<svg class="figure" role="img" viewBox="0 0 {width} {height}" width="{width}" '
        f'xmlns="http://www.w3.org/2000/svg"><title>{escape(title)}</title>'
        f"{''.join(views)}{_legend(height - 8)}</svg>"
    )


def _roads(road_map: RoadMap, centre_m: Float32[np.ndarray, "2"]) -> str:
    """Draw the features that reach into the view, one path per look."""
    points_px = _px(road_map.xyz_m[:, :2], centre_m)
    near = np.asarray((np.abs(points_px - VIEW_PX / 2) < VIEW_PX * 0.6).all(axis=1))
    paths: dict[str, list[str]] = {look: [] for look in _LOOKS.values()}
    for feature in range(road_map.num_features):
        agent_type = FeatureType(road_map.feature_type[feature])
        part = slice(*road_map.point_offsets[feature : feature + 2].tolist())
        if agent_type in _LOOKS and near[part].any():
            # An outline cut short would be another outline.
            keep = near[part] | (_LOOKS[agent_type] == "zebra")
            paths[_LOOKS[agent_type]] += _lines(points_px[part], keep)
    return "".join(
        f'<path class="{look}" d="{"".join(lines)}"/>'
        for look, lines in paths.items()
        if lines
    )


def _lines(
    points_px: Float32[np.ndarray, "point 2"], keep: Bool[np.ndarray, " point"]
) -> list[str]:
    """Write the kept stretches of a line, points less than a few pixels apart left out."""
    found = []
    breaks = np.flatnonzero(np.diff(keep.astype(np.int8), prepend=0, append=0))
    for first, end in breaks.reshape(-1, 2).tolist():
        stretch = points_px[first:end]
        along_px = np.cumsum(
            np.linalg.norm(np.diff(stretch, axis=0, prepend=stretch[:1]), axis=1)
        )
        chosen = np.diff(along_px // 4, prepend=-1) > 0
        chosen[-1] = True
        if chosen.sum() > 1:
            found.append(_path(stretch[chosen]))
    return found


def _agents(moment: _Moment) -> str:
    """Draw boxes, their front end pointed."""
    corners_px = _px(box_corners(moment.pose, moment.size_lw_m), moment.centre_m)
    left, rear_left, rear_right, right = np.moveaxis(corners_px, 1, 0)
    back = _NOTCH * (rear_left - left)
    outlines = np.stack(
        [(left + right) / 2, left + back, rear_left, rear_right, right + back], axis=1
    )
    inside = (np.abs(outlines - VIEW_PX / 2) < VIEW_PX * 0.6).all(axis=(1, 2))
    return "".join(
        f'<path class="agent {moment.looks[row]}" d="{_path(outlines[row])}Z"/>'
        for row in np.flatnonzero(inside).tolist()
    )


def _legend(y_px: int) -> str:
    parts = []
    for at, (look, words) in enumerate(_LEGEND.items()):
        x_px = 4 + 170 * at
        parts.append(
            f'<path class="agent {look}" d="M{x_px} {y_px - 9}h14l6 4l-6 4h-14Z"/>'
            f'<text class="ink" x="{x_px + 28}" y="{y_px}">{escape(words)}</text>'
        )
    return "".join(parts)


def _px(
    xy_m: Float32[np.ndarray, "... 2"], centre_m: Float32[np.ndarray, "2"]
) -> Float32[np.ndarray, "... 2"]:
    """Place points of the world in a view."""
    scale = np.array([1.0, -1.0], np.float32) * np.float32(VIEW_PX / (2 * REACH_M))
    return (xy_m - centre_m) * scale + np.float32(VIEW_PX / 2)


def _path(points_px: Float32[np.ndarray, "point 2"]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points_px.tolist())
