"""Traffic signal states merged into classes, per lane and token step (SPEC 1.4)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int8, Int32, Int64

from infgen.scene import Signals, SignalState
from infgen.tokens.scene_tokens import SignalClass

_CLASS_OF = {
    SignalState.UNKNOWN: SignalClass.UNKNOWN,
    SignalState.ARROW_STOP: SignalClass.STOP,
    SignalState.ARROW_CAUTION: SignalClass.CAUTION,
    SignalState.ARROW_GO: SignalClass.GO,
    SignalState.STOP: SignalClass.STOP,
    SignalState.CAUTION: SignalClass.CAUTION,
    SignalState.GO: SignalClass.GO,
    SignalState.FLASHING_STOP: SignalClass.STOP,
    SignalState.FLASHING_CAUTION: SignalClass.CAUTION,
}
_CLASSES = np.array([_CLASS_OF[state] for state in SignalState], dtype=np.int8)

REMEMBERED = len(SignalClass)
"""Added to the last known class of a signal whose present state is not given."""


def classify_signals(state: Int8[np.ndarray, " signal"]) -> Int8[np.ndarray, " signal"]:
    """Give each ``SignalState`` its ``SignalClass``; states out of range are unknown."""
    known = (state >= 0) & (state < len(_CLASSES))
    return np.where(known, _CLASSES[state * known], np.int8(SignalClass.UNKNOWN))


def signals_at(
    signals: Signals, lane_id: Int64[np.ndarray, " lane"], step: Int64[np.ndarray, " step"]
) -> Int8[np.ndarray, "lane step"]:
    """Return the class of each lane's signal at given steps.

    A lane without a logged state at a step has ``NO_SIGNAL``; of two states the later row
    counts.

    Args:
        signals: All signal states of the log.
        lane_id: Feature ids.
        step: Steps, ascending.
    """
    shown = np.full((len(lane_id), len(step)), SignalClass.NO_SIGNAL, dtype=np.int8)
    if len(lane_id) == 0 or len(signals.step) == 0:
        return shown
    order = np.argsort(lane_id, kind="stable")
    place = np.minimum(np.searchsorted(lane_id[order], signals.lane_id), len(lane_id) - 1)
    lane = order[place]
    column = np.minimum(np.searchsorted(step, signals.step), len(step) - 1)
    rows = np.flatnonzero(
        (lane_id[lane] == signals.lane_id) & (step[column] == signals.step)
    )
    shown[lane[rows], column[rows]] = classify_signals(signals.state[rows])
    return shown


def hold_last_signals(
    shown: Int8[np.ndarray, "signal token"], known: int, tokens: int
) -> Int8[np.ndarray, "signal all_tokens"]:
    """Return signal classes while they are known, then the last known ones.

    Args:
        shown: ``SignalClass`` of each at the end of each token step.
        known: Token steps whose states are known, at least one.
        tokens: Token steps to return; from ``known`` on, ``REMEMBERED`` is added.
    """
    seen, last = shown[:, :known], shown[:, known - 1 : known] + np.int8(REMEMBERED)
    return np.concatenate([seen, np.repeat(last, tokens - known, axis=1)], axis=1)


class LoggedSignals(NamedTuple):
    """Signal classes of a scene at every token step.

    Attributes:
        polyline: Polylines of map tokens that ever have a signal, ascending.
        shown: ``SignalClass`` of each at the end of each token step.
    """

    polyline: Int32[np.ndarray, " signal"]
    shown: Int8[np.ndarray, "signal token"]


def signal_polylines(
    signals: Signals,
    polyline: Int32[np.ndarray, " map_token"],
    feature_id: Int64[np.ndarray, " map_token"],
    last_step: int,
) -> tuple[Int32[np.ndarray, " polyline"], Int64[np.ndarray, " polyline"]]:
    """List the polylines that have a signal up to a step, and their lanes.

    Args:
        signals: All signal states of the log.
        polyline: Polyline of each map token; tokens of one polyline are adjacent.
        feature_id: Map feature of each map token.
        last_step: Later signal states are ignored.
    """
    lanes = np.unique(signals.lane_id[signals.step <= last_step])
    first = np.flatnonzero(np.diff(polyline, prepend=-1))
    rows = first[np.isin(feature_id[first], lanes)]
    return polyline[rows], feature_id[rows]
