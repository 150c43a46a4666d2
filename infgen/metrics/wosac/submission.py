"""Submissions to the Waymo Open Sim Agents Challenge, read without protobuf.

A submission is one or more ``SimAgentsChallengeSubmission`` messages, plain or as members
of the ``.tar.gz`` that is uploaded; a bare ``ScenarioRollouts`` is read too. One scene is
in memory at a time, and members of an archive are never written to disk.

Field numbers, facts of Waymo's published messages: ``SimAgentsChallengeSubmission``
scenario_rollouts = 1; ``ScenarioRollouts`` scenario_id = 1, joint_scenes = 2;
``JointScene`` simulated_trajectories = 1; ``SimulatedTrajectory`` center_x = 2,
center_y = 3, center_z = 4, heading = 5, object_id = 6.
"""

import tarfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol, runtime_checkable

import numpy as np

from infgen.metrics.wosac.rollouts import Rollouts, list_ids
from infgen.sources.wire import (
    BYTES,
    FIXED32,
    VARINT,
    Field,
    WireError,
    last,
    read_field,
    read_varint,
    signed,
    tag,
    walk,
)

NUM_ROLLOUTS = 32
MAX_SCENE_BYTES = 1 << 28
"""No scene of a submission is larger (32 rollouts of 128 agents are 6 MB)."""
MAX_HEAD_BYTES = 20
"""A tag and a length are no longer."""

_ROLLOUTS, _SCENARIO_ID, _JOINT = tag(1, BYTES), tag(1, BYTES), tag(2, BYTES)
_TRAJECTORY, _OBJECT_ID = tag(1, BYTES), tag(6, VARINT)
_AXES = {"center_x": 2, "center_y": 3, "center_z": 4, "heading": 5}


@runtime_checkable
class Readable(Protocol):
    """A file, or a member of an archive."""

    def read(self, size: int, /) -> bytes:
        """Read up to so many bytes."""
        ...


class Refused(NamedTuple):
    """A part of a submission that cannot be scored.

    Attributes:
        name: Scene, or file where no scene could be read.
        reason: In one line.
    """

    name: str
    reason: str


class _SceneError(ValueError):
    """What is wrong with one scene."""


def read_submission(
    path: Path,
    num_rollouts: int = NUM_ROLLOUTS,
    tell_bytes: Callable[[int], None] = lambda _: None,
) -> Iterator[Rollouts | Refused]:
    """Stream the scenes of a submission; a wrong one comes with the reason.

    Args:
        path: A binary message, or a tar archive of such, compressed or not.
        num_rollouts: How many rollouts every scene must have; 0 for any.
        tell_bytes: Called before each scene with the number of bytes read.

    Raises:
        OSError: if the file cannot be read.
    """
    is_archive = tarfile.is_tarfile(path)
    with path.open("rb") as file:
        if is_archive:
            scenes = _read_archive(path.name, file, num_rollouts)
        else:
            scenes = _read_file(path.name, file, path.stat().st_size, num_rollouts)
        for scene in scenes:
            tell_bytes(file.tell())
            yield scene


def _read_archive(
    name: str, file: BinaryIO, num_rollouts: int
) -> Iterator[Rollouts | Refused]:
    try:
        with tarfile.open(fileobj=file, mode="r|*") as archive:
            yield from _read_members(archive, num_rollouts)
    except (tarfile.TarError, EOFError, zlib.error) as error:
        yield Refused(name, f"the archive is damaged: {error}")


def _read_members(
    archive: tarfile.TarFile, num_rollouts: int
) -> Iterator[Rollouts | Refused]:
    for member in archive:
        if member.isdir():
            continue
        file = archive.extractfile(member) if member.isreg() else None
        if file is None:
            yield Refused(member.name, "not a plain file in the archive")
        else:
            yield from _read_file(member.name, file, member.size, num_rollouts)


def _read_file(
    name: str, file: Readable, size: int, num_rollouts: int
) -> Iterator[Rollouts | Refused]:
    """Read one message, scene by scene."""
    found = 0
    try:
        for scene in _scene_bytes(file, size):
            found += 1
            yield _decode(name, scene, num_rollouts)
    except WireError as error:
        yield Refused(name, f"not a submission: {error}")
        return
    if not found:
        yield Refused(name, "holds no scenario_rollouts")


def _scene_bytes(file: Readable, size: int) -> Iterator[bytes]:
    """Yield each ``ScenarioRollouts`` of a submission; a bare one is yielded whole.

    Raises:
        WireError: where the message stops being sound.
    """
    head, at = b"", 0
    while at < size:
        head += file.read(MAX_HEAD_BYTES - len(head))
        field = _first_field(head)
        if field.end > MAX_SCENE_BYTES:
            raise WireError(f"field {field.tag >> 3} at byte {at} holds {field.end} bytes")
        data = head + file.read(max(0, field.end - len(head)))
        if len(data) < field.end:
            raise WireError(f"the file ends within field {field.tag >> 3} at byte {at}")
        if at == 0 and not _is_submission(data, field):
            yield data + file.read(min(size, MAX_SCENE_BYTES) - len(data))
            return
        if field.tag == _ROLLOUTS:
            yield data[field.start : field.end]
        head, at = data[field.end :], at + field.end


def _first_field(head: bytes) -> Field:
    """Read the field that starts a head; a message or text in it may go on beyond."""
    key, start = read_varint(head, 0, len(head))
    if key & 7 != BYTES:
        return read_field(head, 0, len(head))
    size, start = read_varint(head, start, len(head))
    return Field(key, 0, start, start + size)


def _is_submission(data: bytes, field: Field) -> bool:
    """Tell a submission from bare ``ScenarioRollouts`` by the first field's content.

    Of the one it is a message with joint scenes, of the other a name.
    """
    if field.tag != _ROLLOUTS:
        return True
    try:
        inner = walk(data, field.start, field.end)
    except WireError:
        return False
    return any(part.tag == _JOINT for part in inner)


def _decode(name: str, data: bytes, num_rollouts: int) -> Rollouts | Refused:
    """Decode one ``ScenarioRollouts``."""
    scenario_id = name
    try:
        fields = walk(data, 0, len(data))
        ids = [data[f.start : f.end] for f in fields if f.tag == _SCENARIO_ID]
        if not ids:
            raise _SceneError("a scene without scenario_id")
        scenario_id = ids[-1].decode()
        joint = [field for field in fields if field.tag == _JOINT]
        if num_rollouts and len(joint) != num_rollouts:
            raise _SceneError(f"has {len(joint)} rollouts; expected {num_rollouts}")
        if not joint:
            raise _SceneError("has no rollouts")
        return _gather(scenario_id, [_read_joint(data, field) for field in joint])
    except (_SceneError, WireError, UnicodeDecodeError) as error:
        return Refused(scenario_id, str(error))


class _Joint(NamedTuple):
    """One rollout: ids [object] and values [axis, object, step]."""

    object_id: np.ndarray
    values: np.ndarray


def _read_joint(data: bytes, joint: Field) -> _Joint:
    """Decode one ``JointScene``, its objects in ascending order of id."""
    ids, rows = [], []
    for part in walk(data, joint.start, joint.end):
        if part.tag != _TRAJECTORY:
            continue
        fields = walk(data, part.start, part.end)
        ids.append(signed(last(fields, _OBJECT_ID, -1), 32))
        rows.append([_floats(data, fields, number) for number in _AXES.values()])
    if not ids:
        raise _SceneError("a rollout without trajectories")
    _check_lengths(ids, rows)
    order = np.argsort(ids, kind="stable")
    values = np.array(rows, dtype=np.float32)[order]  # [object, axis, step]
    return _Joint(np.array(ids, dtype=np.int64)[order], np.moveaxis(values, 1, 0))


def _check_lengths(ids: Sequence[int], rows: Sequence[Sequence[np.ndarray]]) -> None:
    """Refuse trajectories that are not all of one length."""
    steps = len(rows[0][0])
    for object_id, row in zip(ids, rows, strict=True):
        for axis, values in zip(_AXES, row, strict=True):
            if len(values) != steps:
                raise _SceneError(
                    f"object {object_id} has {len(values)} values of {axis}, "
                    f"object {ids[0]} has {steps} of center_x"
                )


def _gather(scenario_id: str, joints: Sequence[_Joint]) -> Rollouts:
    """Stack the rollouts of a scene, which must be of the same objects and length."""
    first = joints[0]
    for at, joint in enumerate(joints):
        odd = np.setxor1d(first.object_id, joint.object_id)
        if len(odd):
            raise _SceneError(
                f"rollouts 0 and {at} are not of the same objects: {list_ids(odd)}"
            )
        if joint.values.shape != first.values.shape:
            raise _SceneError(
                f"rollout {at} has {joint.values.shape[1]} trajectories of "
                f"{joint.values.shape[2]} steps, rollout 0 has {first.values.shape[1]} of "
                f"{first.values.shape[2]}"
            )
    values = np.stack([joint.values for joint in joints], axis=1)
    return Rollouts(
        scenario_id=scenario_id,
        object_id=first.object_id,
        x_m=values[0],
        y_m=values[1],
        z_m=values[2],
        heading_rad=values[3],
    )


def _floats(data: bytes, fields: Sequence[Field], number: int) -> np.ndarray:
    """Values [value] of a repeated float field, packed or not.

    Raises:
        WireError: if packed values are not a whole number of floats.
    """
    parts = [np.zeros(0, dtype="<f4")]
    for field in fields:
        if field.tag in (tag(number, BYTES), tag(number, FIXED32)):
            count, rest = divmod(field.end - field.start, 4)
            if rest:
                raise WireError(f"packed field {number} is not a whole number of floats")
            parts.append(np.frombuffer(data, "<f4", count, field.start))
    return np.concatenate(parts)
