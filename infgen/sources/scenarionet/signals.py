"""Traffic lights of a ScenarioNet description, one per lane."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64, Int64

from infgen.scene import Signals, SignalState
from infgen.sources.ids import integer_name
from infgen.sources.scenarionet.parts import Part, points_of, sequence_of
from infgen.sources.scenarionet.pickles import array
from infgen.sources.tfrecord import RecordError

_PREFIX = "LANE_STATE_"
STATES: Mapping[str, SignalState] = {
    **{f"{_PREFIX}{state.name}": state for state in SignalState},
    "TRAFFIC_LIGHT_GREEN": SignalState.GO,
    "TRAFFIC_LIGHT_YELLOW": SignalState.CAUTION,
    "TRAFFIC_LIGHT_RED": SignalState.STOP,
    "TRAFFIC_LIGHT_UNKNOWN": SignalState.UNKNOWN,
}
"""WOMD's names, and the colours that MetaDrive makes of them."""
STOP_POINTS = "stop_point"
"""Of a light: one point; among its states, where we wrote it, one of each step."""
RANK = "infgen_rank"
"""Among states: place of the light among those of its step, where it is not the order."""
MAX_LIGHTS = 5_000


def read_signals(
    lights: Mapping[str, Part],
    lane_ids: Mapping[str, int],
    num_steps: int,
    origin_xyz_m: Float64[np.ndarray, "3"],
) -> Signals:
    """Read the states of all lights; steps at which a light has none are left out.

    Raises:
        RecordError: if a light has not as many states as there are steps, or a stop point
            that is not finite.
    """
    if len(lights) > MAX_LIGHTS:
        raise RecordError(f"description has {len(lights)} traffic lights")
    step, rank, lane, state, stop = [], [], [], [], []
    for place, (name, light) in enumerate(lights.items()):
        known = light.get("state")
        known = known if isinstance(known, dict) else {}
        shown = sequence_of(known.get("object_state"))
        if len(shown) != num_steps:
            raise RecordError(
                f"light {name[:40]} has {len(shown)} states for {num_steps} steps"
            )
        seen = [row for row, each in enumerate(shown) if isinstance(each, str)]
        ranks = _ranks(known.get(RANK), place, num_steps)
        step += seen
        rank += ranks[seen].tolist()
        lane += [_lane(light.get("lane"), name, lane_ids)] * len(seen)
        state += [STATES.get(shown[row], SignalState.UNKNOWN) for row in seen]
        stop.append(_stops(light, known, name, num_steps)[seen])
    order = np.lexsort((rank, step))
    stop_m = np.concatenate([np.empty((0, 3)), *stop]) - origin_xyz_m
    with np.errstate(over="ignore", invalid="ignore"):
        local_m = stop_m.astype(np.float32)
    if not np.isfinite(local_m).all():
        raise RecordError("a signal has a stop point that is not finite")
    return Signals(
        step=np.array(step, np.int16)[order],
        lane_id=np.array(lane, np.int64)[order],
        state=np.array(state, np.int8)[order],
        stop_xyz_m=local_m[order],
    )


def _lane(lane: object, name: str, lane_ids: Mapping[str, int]) -> int:
    """Feature id of the lane that a light is for; the light's own name may be it."""
    for word in (str(lane), name):
        if word in lane_ids:
            return lane_ids[word]
        if (number := integer_name(word)) is not None:
            return number
    raise RecordError(
        f"light {name[:40]} is of lane {str(lane)[:40]!r}, which is not there"
    )


def _ranks(found: object, place: int, num_steps: int) -> Int64[np.ndarray, " step"]:
    if found is None:
        return np.full(num_steps, place)
    ranks = array(found, np.int64)
    if ranks.shape != (num_steps,):
        raise RecordError(f"ranks of a light have shape {ranks.shape}")
    return ranks


def _stops(
    light: Part, known: Part, name: str, num_steps: int
) -> Float64[np.ndarray, "step 3"]:
    """Stop points of all steps; the world's origin where there is none, as in WOMD."""
    found = points_of(known.get(STOP_POINTS, light.get(STOP_POINTS)), f"light {name[:40]}")
    if not len(found):
        return np.zeros((num_steps, 3))
    found = np.pad(found[:, :3], ((0, 0), (0, max(0, 3 - found.shape[1]))))
    if len(found) not in (1, num_steps):
        raise RecordError(f"light {name[:40]} has {len(found)} stop points")
    return np.broadcast_to(found, (num_steps, 3))
