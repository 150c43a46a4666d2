"""What the recording car sees of traffic lights, step by step."""

import numpy as np
from jaxtyping import Float64

from infgen.clock import CLOCK
from infgen.scene import RoadMap, Signals, SignalState
from infgen.sources.towns.streets.network import Connector, SignalPlan
from infgen.sources.towns.town import Town

SEEN_M = 65.0
"""Lights are seen from within this distance."""
_STATES = {
    "G": SignalState.GO,
    "g": SignalState.GO,
    "y": SignalState.CAUTION,
    "Y": SignalState.CAUTION,
}
_ARROWS = {
    SignalState.GO: SignalState.ARROW_GO,
    SignalState.CAUTION: SignalState.ARROW_CAUTION,
    SignalState.STOP: SignalState.ARROW_STOP,
}


def draw_signals(
    town: Town, road_map: RoadMap, first_step: int, eye_m: Float64[np.ndarray, "step 2"]
) -> Signals:
    """Record the lights of the map's lanes while they are in sight.

    Args:
        town: The town.
        road_map: The part of its map that the log has, in the log's frame.
        first_step: Of the recording, in the town's time.
        eye_m: Where the recording car is, in the town's frame.
    """
    row_of = {int(feature): row for row, feature in enumerate(road_map.feature_id)}
    lit = [
        each
        for each in town.network.connectors
        if each.signal and town.lane_ids[each.name] in row_of
    ]
    feature = np.array([row_of[town.lane_ids[each.name]] for each in lit], np.int64)
    plans = [town.network.signals[each.signal] for each in lit]
    arrows = [_has_arrow(each, plan) for each, plan in zip(lit, plans, strict=True)]
    stops_m = np.array([each.xy_m[0] for each in lit]).reshape(-1, 2)
    rows = []
    for step, at_m in enumerate(eye_m):
        time_s = town.begins_s + (first_step + step) * CLOCK.step_s
        near = np.linalg.norm(stops_m - at_m, axis=1) < SEEN_M
        for at in np.flatnonzero(near).tolist():
            letter = plans[at].shown(time_s)[lit[at].index]
            rows.append((step, feature[at], _state(letter, arrow=arrows[at])))
    steps, features, states = np.array(rows, np.int64).reshape(-1, 3).T
    return Signals(
        step=steps.astype(np.int16),
        lane_id=road_map.feature_id[features],
        state=states.astype(np.int8),
        stop_xyz_m=road_map.xyz_m[road_map.point_offsets[features]],
    )


def _state(letter: str, *, arrow: bool) -> SignalState:
    """What a light shows to a way across a junction."""
    state = _STATES.get(letter, SignalState.STOP)
    # Who may turn but must give way sees no arrow.
    return _ARROWS[state] if arrow and letter != "g" else state


def _has_arrow(connector: Connector, plan: SignalPlan) -> bool:
    """Whether a light stops all others for those who turn left."""
    letters = {state[connector.index] for state in plan.states}
    return connector.turn == "l" and "G" in letters
