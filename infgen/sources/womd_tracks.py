"""WOMD's ``Track`` messages -> ``Tracks``, and the origin they are measured from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from infgen.scene import AgentType, Tracks
from infgen.sources import wire
from infgen.sources.batch import decode, messages
from infgen.sources.tfrecord import RecordError
from infgen.sources.wire import BYTES, FIXED32, FIXED64, VARINT, Field, Spans, tag

MAX_ORIGIN_M = 1 << 23
"""Farther out float32 no longer holds every whole metre and its half."""

_ID, _TYPE, _STATES = tag(1, VARINT), tag(2, VARINT), tag(3, BYTES)
_MAX_TYPE = 4
_STATE = {
    "x": tag(2, FIXED64),
    "y": tag(3, FIXED64),
    "z": tag(4, FIXED64),
    "length": tag(5, FIXED32),
    "width": tag(6, FIXED32),
    "height": tag(7, FIXED32),
    "heading": tag(8, FIXED32),
    "velocity_x": tag(9, FIXED32),
    "velocity_y": tag(10, FIXED32),
    "valid": tag(11, VARINT),
}


@dataclass(frozen=True, slots=True)
class WorldTracks:
    """Tracks as the record has them: world frame, float64, whatever invalid states hold."""

    id: Int32[np.ndarray, " agent"]
    type: Int32[np.ndarray, " agent"]
    xyz_m: Float64[np.ndarray, "agent step 3"]
    heading_rad: Float32[np.ndarray, "agent step"]
    velocity_mps: Float32[np.ndarray, "agent step 2"]
    size_lwh_m: Float32[np.ndarray, "agent step 3"]
    valid: Bool[np.ndarray, "agent step"]

    def around(self, origin_xyz_m: Float64[np.ndarray, "3"]) -> Tracks:
        """Return the tracks in metres around an origin.

        Values that are not finite become the record's zero where the state is invalid.

        Raises:
            RecordError: if a valid state holds a value that is not finite.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            local_m = (self.xyz_m - origin_xyz_m).astype(np.float32)
        zero_m = (-origin_xyz_m).astype(np.float32)
        return Tracks(
            id=self.id,
            agent_type=_agent_types(self.type),
            xyz_m=self._finite(local_m, "position", zero_m),
            heading_rad=self._finite(self.heading_rad, "heading"),
            velocity_mps=self._finite(self.velocity_mps, "velocity"),
            size_lwh_m=self._finite(self.size_lwh_m, "size"),
            valid=self.valid,
        )

    def _finite(
        self,
        values: Float32[np.ndarray, "agent step ..."],
        what: str,
        zero: Float32[np.ndarray, "3"] | float = 0.0,
    ) -> Float32[np.ndarray, "agent step ..."]:
        finite = np.isfinite(values)
        if finite.all():
            return values
        whole = finite.reshape(*self.valid.shape, -1).all(axis=-1)
        bad = np.argwhere(self.valid & ~whole)
        if len(bad):
            agent, step = bad[0]
            raise RecordError(
                f"track {self.id[agent]} has a {what} that is not finite at step {step}"
            )
        return np.where(finite, values, np.float32(zero))


def read_tracks(data: bytes, tracks: Sequence[Field], num_steps: int) -> WorldTracks:
    """Decode all tracks of a record.

    Raises:
        WireError: if a message is not sound.
        RecordError: if there are no tracks, two have one id, or one has not as many states
            as there are timestamps.
    """
    if not tracks:
        raise RecordError("record has no tracks")
    states, ids, types = Spans(), [], []
    for track in tracks:
        before = states.total
        fields = wire.split(data, track.start, track.end, _STATES, states)
        ids.append(wire.signed(wire.last(fields, _ID), 32))
        types.append(wire.last_enum(fields, _TYPE, _MAX_TYPE))
        if states.total - before != num_steps:
            raise RecordError(
                f"track {ids[-1]} has {states.total - before} states for "
                f"{num_steps} timestamps"
            )
    _check_unique(ids)
    table = decode(data, messages(states), _STATE)
    table = {name: column.reshape(-1, num_steps) for name, column in table.items()}
    return WorldTracks(
        id=np.array(ids, np.int32),
        type=np.array(types, np.int32),
        xyz_m=_stack(table, "x", "y", "z"),
        heading_rad=table["heading"],
        velocity_mps=_stack(table, "velocity_x", "velocity_y"),
        size_lwh_m=_stack(table, "length", "width", "height"),
        valid=table["valid"] != 0,
    )


def origin_near(tracks: WorldTracks, ego: int, now: int) -> Float64[np.ndarray, "3"]:
    """Return the whole metres nearest to the ego now.

    Raises:
        RecordError: if the ego has no usable state now.
    """
    if not tracks.valid[ego, now]:
        raise RecordError(f"ego (track {tracks.id[ego]}) is not valid at step {now}")
    xyz_m = tracks.xyz_m[ego, now]
    if not (np.abs(xyz_m) < MAX_ORIGIN_M).all():
        raise RecordError(f"ego stands at {xyz_m.tolist()} m: not finite or too far out")
    return np.round(xyz_m) + 0.0  # No negative zeros.


def _agent_types(types: Int32[np.ndarray, " agent"]) -> np.ndarray:
    """Turn WOMD's object types into ``AgentType``: less one; the unset ones are other."""
    return np.where(types == 0, AgentType.OTHER, types - 1).astype(np.int8)


def _check_unique(ids: list[int]) -> None:
    seen: set[int] = set()
    for track_id in ids:
        if track_id in seen:
            raise RecordError(f"two tracks have id {track_id}")
        seen.add(track_id)


def _stack(table: dict[str, np.ndarray], *names: str) -> Float[np.ndarray, "agent step n"]:
    return np.stack([table[name] for name in names], axis=-1)
