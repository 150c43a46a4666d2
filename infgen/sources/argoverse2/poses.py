"""Poses in space, as quaternions and translations, and their interpolation."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from infgen.sources.tfrecord import RecordError


def rotations(
    quaternion_wxyz: Float64[np.ndarray, "pose 4"],
) -> Float64[np.ndarray, "pose 3 3"]:
    """Turn quaternions, of any length but zero, into rotation matrices."""
    w, x, y, z = (quaternion_wxyz / np.linalg.norm(quaternion_wxyz, axis=1)[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of one body over time.

    Attributes:
        time_ns: When.
        quaternion_wxyz: Rotation from the body to the city frame.
        xyz_m: The body's origin in the city frame.
    """

    time_ns: Int64[np.ndarray, " pose"]
    quaternion_wxyz: Float64[np.ndarray, "pose 4"]
    xyz_m: Float64[np.ndarray, "pose 3"]

    def at(self, time_ns: Int64[np.ndarray, " time"]) -> "Poses":
        """Interpolate to other times; before the first and after the last pose stay put.

        These poses must be in the order of their times, each time once. Translations
        go linearly, rotations the shorter way (linear and normalised, which is as good for
        poses a few milliseconds apart).
        """
        after = np.clip(np.searchsorted(self.time_ns, time_ns), 1, len(self.time_ns) - 1)
        before = np.maximum(after - 1, 0)
        after = np.minimum(after, len(self.time_ns) - 1)
        span_ns = np.maximum(self.time_ns[after] - self.time_ns[before], 1)
        share = np.clip((time_ns - self.time_ns[before]) / span_ns, 0, 1)[:, None]
        one, two = self.quaternion_wxyz[before], self.quaternion_wxyz[after]
        two = np.where((one * two).sum(axis=1, keepdims=True) < 0, -two, two)
        return Poses(
            time_ns,
            one * (1 - share) + two * share,
            self.xyz_m[before] * (1 - share) + self.xyz_m[after] * share,
        )

    def to_city(
        self, points_m: Float64[np.ndarray, "pose 3"]
    ) -> Float64[np.ndarray, "pose 3"]:
        """Bring one point per pose from the body to the city frame."""
        turned = np.einsum("pij,pj->pi", rotations(self.quaternion_wxyz), points_m)
        return turned + self.xyz_m

    def headings(
        self, ahead: Float64[np.ndarray, "pose 3"]
    ) -> Float64[np.ndarray, " pose"]:
        """Headings in the city frame of directions in the body frame, one per pose."""
        turned = np.einsum("pij,pj->pi", rotations(self.quaternion_wxyz), ahead)
        return np.arctan2(turned[:, 1], turned[:, 0])


def check_rotations(quaternion_wxyz: Float64[np.ndarray, "pose 4"], what: str) -> None:
    """Refuse quaternions that are no rotation.

    Raises:
        RecordError: if one is zero or not finite.
    """
    length = np.linalg.norm(quaternion_wxyz, axis=1)
    if not (np.isfinite(length) & (length > 1e-6)).all():
        raise RecordError(f"a {what} has no rotation: its quaternion is zero or not finite")
