"""WOMD's ``DynamicMapState`` messages -> ``Signals``."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from infgen.scene import Signals, SignalState
from infgen.sources import wire
from infgen.sources.batch import Messages, decode, messages
from infgen.sources.tfrecord import RecordError
from infgen.sources.wire import BYTES, VARINT, Field, Spans, tag
from infgen.sources.womd_roads import read_points

_LANE_STATES = tag(1, BYTES)
_LANE_STATE = {"lane": tag(1, VARINT), "state": tag(2, VARINT), "stop_point": tag(3, BYTES)}


def read_signals(
    data: bytes,
    steps: Sequence[Field],
    num_steps: int,
    origin_xyz_m: Float64[np.ndarray, "3"],
) -> Signals:
    """Decode the traffic signals of all steps, stop points in metres around an origin.

    A missing stop point is the record's zero, as protobuf has it.

    Raises:
        WireError: if a message is not sound.
        RecordError: if there are not as many dynamic states as timestamps (or none at all),
            or a stop point is not finite.
    """
    if steps and len(steps) != num_steps:
        raise RecordError(f"{len(steps)} dynamic map states for {num_steps} timestamps")
    spans, counts = Spans(), []
    for step in steps:
        before = spans.total
        wire.split(data, step.start, step.end, _LANE_STATES, spans)
        counts.append(spans.total - before)
    table = decode(data, messages(spans), _LANE_STATE)
    states = np.where(table["state"] > max(SignalState), 0, table["state"])
    points = Messages(np.maximum(table["stop_point"], 0), table["stop_point.size"])
    stop_xyz_m = read_points(data, points, origin_xyz_m)
    if not np.isfinite(stop_xyz_m).all():
        raise RecordError("a signal has a stop point that is not finite")
    return Signals(
        step=np.repeat(np.arange(len(steps)), counts).astype(np.int16),
        lane_id=table["lane"].astype(np.int64),
        state=states.astype(np.int8),
        stop_xyz_m=stop_xyz_m,
    )
