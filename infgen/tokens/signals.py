"""Traffic lights as classes: what a driver does about them (SPEC 1.4)."""

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
"""Added to the class of a light that nobody has looked at since: it may have changed."""


def classify_signals(state: Int8[np.ndarray, " signal"]) -> Int8[np.ndarray, " signal"]:
    """Give each ``SignalState`` its ``SignalClass``; an unheard-of state is unknown."""
    known = (state >= 0) & (state < len(_CLASSES))
    return np.where(known, _CLASSES[state * known], np.int8(SignalClass.UNKNOWN))


def signals_at(
    signals: Signals, lane_id: Int64[np.ndarray, " lane"], step: Int64[np.ndarray, " step"]
) -> Int8[np.ndarray, "lane step"]:
    """Return the class that each lane's light shows at some steps.

    A lane that the log gives no state at a step has ``NO_SIGNAL`` there; of two states the
    later row counts.

    Args:
        signals: All lights of the log.
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
    shown: Int8[np.ndarray, "light token"], known: int, tokens: int
) -> Int8[np.ndarray, "light all_tokens"]:
    """Return what lights show while they are looked at, then what they showed last.

    Args:
        shown: ``SignalClass`` of each at the end of each half second.
        known: Half seconds in which they are looked at, at least one.
        tokens: Half seconds to tell of; from ``known`` on, classes are ``REMEMBERED``.
    """
    seen, last = shown[:, :known], shown[:, known - 1 : known] + np.int8(REMEMBERED)
    return np.concatenate([seen, np.repeat(last, tokens - known, axis=1)], axis=1)


class LoggedSignals(NamedTuple):
    """What the traffic lights of a scene show.

    Attributes:
        polyline: Lines of road tokens that ever have a light, ascending.
        shown: ``SignalClass`` of each at the end of each half second.
    """

    polyline: Int32[np.ndarray, " light"]
    shown: Int8[np.ndarray, "light token"]


def signal_polylines(
    signals: Signals,
    line: Int32[np.ndarray, " road"],
    feature_id: Int64[np.ndarray, " road"],
    last_step: int,
) -> tuple[Int32[np.ndarray, " line"], Int64[np.ndarray, " line"]]:
    """List the lines of road tokens that have a light up to a step, and their lanes.

    Args:
        signals: All lights of the log.
        line: Line of each road token; tokens of one line are adjacent.
        feature_id: Map feature of each road token.
        last_step: Later lights are not looked at.
    """
    lanes = np.unique(signals.lane_id[signals.step <= last_step])
    first = np.flatnonzero(np.diff(line, prepend=-1))
    rows = first[np.isin(feature_id[first], lanes)]
    return line[rows], feature_id[rows]
