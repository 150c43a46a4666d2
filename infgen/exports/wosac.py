"""Submissions to the Waymo Open Sim Agents Challenge, written without protobuf.

Inverse of ``infgen.metrics.wosac.submission``. What Waymo's own check asks of a scene:
exactly 32 rollouts, each with every track that the log shows at now (of any type), and no
other, for 80 steps.

Field numbers, facts of Waymo's published messages: ``SimAgentsChallengeSubmission``
scenario_rollouts = 1, submission_type = 2, then the fields of ``About``;
``ScenarioRollouts`` scenario_id = 1, joint_scenes = 2; ``JointScene``
simulated_trajectories = 1; ``SimulatedTrajectory`` center_x = 2, center_y = 3,
center_z = 4, heading = 5, object_id = 6.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float32, Int64
from pydantic.dataclasses import dataclass as settings_dataclass

from infgen.clock import CLOCK
from infgen.errors import ConfigError
from infgen.metrics.wosac.logged import FUTURE_STEPS
from infgen.metrics.wosac.rollouts import Rollouts, RolloutsError, from_rollouts, list_ids
from infgen.metrics.wosac.submission import NUM_ROLLOUTS
from infgen.rollout.rollout import Rollout
from infgen.scene import AgentType, Scene
from infgen.settings import RULES
from infgen.sources.wire import BYTES, VARINT
from infgen.sources.wire_write import integer, key, message, text, varint

HOW = "`infgen rollout -s rollout.mode=wosac -s rollout.count=32` plays what is asked"
_SIM_AGENTS = 1
"""Submission type of the challenge."""
_NUMBERS = {
    "account_name": 3,
    "unique_method_name": 4,
    "authors": 5,
    "affiliation": 6,
    "description": 7,
    "method_link": 8,
    "uses_lidar_data": 9,
    "uses_camera_data": 10,
    "uses_public_model_pretraining": 11,
    "num_model_parameters": 12,
    "public_model_names": 13,
    "acknowledge_complies_with_closed_loop_requirement": 14,
}
_COUNT = re.compile(r"[0-9]+[KMBT]?")


@settings_dataclass(frozen=True, slots=True, config=RULES)
class About:
    """Who submits what, under the names that Waymo gives the fields.

    Attributes:
        account_name: Full email address registered with Waymo.
        unique_method_name: Short and unique; a later submission under it replaces this one.
        authors: One name each.
        acknowledge_complies_with_closed_loop_requirement: Whether the method keeps to the
            challenge's rule of closed-loop simulation at 10 Hz. Yours to say: our models
            choose every agent's motion for half a second at a time.
        num_model_parameters: A whole number and perhaps K, M, B or T, such as ``11M``.
        affiliation: Of the authors.
        description: Of the method, in brief.
        method_link: To a paper, say.
        uses_lidar_data: Our models do not.
        uses_camera_data: Our models do not.
        uses_public_model_pretraining: Our models do not.
        public_model_names: Of models pretrained by others.
    """

    account_name: str
    unique_method_name: str
    authors: tuple[str, ...]
    acknowledge_complies_with_closed_loop_requirement: bool
    num_model_parameters: str = ""
    affiliation: str = ""
    description: str = ""
    method_link: str = ""
    uses_lidar_data: bool = False
    uses_camera_data: bool = False
    uses_public_model_pretraining: bool = False
    public_model_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what Waymo would.

        Raises:
            ConfigError: naming the field, its value and what is expected.
        """
        for name, right, expected in (
            ("account_name", "@" in self.account_name, "the email registered with Waymo"),
            ("unique_method_name", self.unique_method_name.strip(), "a short name"),
            ("authors", any(map(str.strip, self.authors)), "one name or more"),
            ("num_model_parameters", self._is_counted(), "a number such as 11M"),
        ):
            if not right:
                raise ConfigError(f"{name} is {getattr(self, name)!r}; expected {expected}")
        if self.uses_public_model_pretraining and not self.public_model_names:
            raise ConfigError("public_model_names is empty; expected the pretrained models")

    def _is_counted(self) -> bool:
        """An unknown number may still be filled in; see ``with_parameters``."""
        count = self.num_model_parameters
        return not count or _COUNT.fullmatch(count) is not None

    def with_parameters(self, count: int) -> "About":
        """Fill in the number of parameters where it is not told."""
        if self.num_model_parameters:
            return self
        return replace(self, num_model_parameters=in_words(count))


@dataclass(frozen=True, slots=True)
class Futures:
    """What a submission holds of one scene.

    Attributes:
        rollouts: 32 of them, objects in the order of the log.
        filled: Track ids that the model does not play: they go on with the velocity, height
            and heading that they have now.
    """

    rollouts: Rollouts
    filled: Int64[np.ndarray, " object"]


def complete(scene: Scene, rollouts: Sequence[Rollout]) -> Futures:
    """Make the futures of one scene what a submission must hold.

    Of more than 32 rollouts the first are taken. Agents of kind ``other`` have no moves and
    are not played by any model here, but must be there: they keep their velocity.

    Raises:
        RolloutsError: naming the scene, what is wrong with its rollouts, and how many.
    """
    where = f"scene {scene.scenario_id}"
    if len(rollouts) < NUM_ROLLOUTS:
        raise RolloutsError(
            f"{where}: has {len(rollouts)} rollouts; expected {NUM_ROLLOUTS} ({HOW})"
        )
    chosen = sorted(rollouts, key=lambda one: one.index)[:NUM_ROLLOUTS]
    played = from_rollouts(chosen)
    shown = np.flatnonzero(scene.tracks.valid[:, scene.now])
    expected = scene.tracks.id[shown].astype(np.int64)
    there = np.isin(expected, played.object_id)
    unplayed = ~there & (scene.tracks.agent_type[shown] == AgentType.OTHER)
    _check_objects(where, expected[there | unplayed], expected, played.object_id)
    joined = _join(played, _keep_velocity(scene, shown[unplayed]), expected)
    _check_finite(where, joined)
    return Futures(joined, expected[unplayed])


def encode_futures(rollouts: Rollouts) -> bytes:
    """Write one scene as a ``scenario_rollouts`` field of a submission."""
    axes = (rollouts.x_m, rollouts.y_m, rollouts.z_m, rollouts.heading_rad)
    values = np.stack(axes, axis=2).astype("<f4")  # [rollout, object, axis, step]
    steps = values.shape[-1]
    heads = np.array(
        [list(key(2 + axis, BYTES) + varint(4 * steps)) for axis in range(len(axes))],
        np.uint8,
    )
    heads = np.broadcast_to(heads, (*values.shape[:3], heads.shape[-1]))
    bodies = np.concatenate([heads, np.ascontiguousarray(values).view(np.uint8)], axis=-1)
    ends = [key(6, VARINT) + varint(track) for track in rollouts.object_id.tolist()]
    scenes = [
        message(
            2,
            b"".join(
                message(1, body.tobytes() + end)
                for body, end in zip(joint, ends, strict=True)
            ),
        )
        for joint in bodies.reshape(*bodies.shape[:2], -1)
    ]
    return message(1, text(1, rollouts.scenario_id) + b"".join(scenes))


def encode_about(about: About) -> bytes:
    """Write all other fields of a submission: its type, and who submits what."""
    parts = [integer(2, _SIM_AGENTS)]
    given = {field.name: getattr(about, field.name) for field in fields(about)}
    for name, number in _NUMBERS.items():
        value = given[name]
        if isinstance(value, bool):
            parts.append(integer(number, int(value)))
        elif isinstance(value, tuple):
            parts += [text(number, each) for each in value]
        elif value:
            parts.append(text(number, value))
    return b"".join(parts)


def in_words(count: int) -> str:
    """Write a number of parameters as Waymo asks: a whole number and K or M."""
    for size, sign in ((10**6, "M"), (10**3, "K")):
        if count >= size:
            return f"{round(count / size)}{sign}"
    return str(count)


def _check_objects(
    where: str,
    found: Int64[np.ndarray, " found"],
    expected: Int64[np.ndarray, " expected"],
    played: Int64[np.ndarray, " played"],
) -> None:
    missing, strange = np.setdiff1d(expected, found), np.setdiff1d(played, expected)
    if len(missing):
        raise RolloutsError(
            f"{where}: {len(missing)} of {len(expected)} agents observed now do not live "
            f"through all rollouts: {list_ids(missing)} ({HOW})"
        )
    if len(strange):
        raise RolloutsError(
            f"{where}: {len(strange)} agents that the log does not show now: "
            f"{list_ids(strange)}"
        )


def _check_finite(where: str, rollouts: Rollouts) -> None:
    values = np.stack([rollouts.x_m, rollouts.y_m, rollouts.z_m, rollouts.heading_rad])
    if not np.isfinite(values).all():
        _, rollout, row, step = np.argwhere(~np.isfinite(values))[0]
        raise RolloutsError(
            f"{where}: rollout {rollout}, agent {rollouts.object_id[row]}, step {step} "
            "holds a value that is not finite"
        )


@dataclass(frozen=True, slots=True)
class _Kept:
    """Tracks that keep their velocity: the same in every rollout.

    Attributes:
        object_id: Track ids.
        values: x, y, z and heading of every step after now, world frame.
    """

    object_id: Int64[np.ndarray, " object"]
    values: Float32[np.ndarray, "4 object step"]


def _keep_velocity(scene: Scene, rows: Int64[np.ndarray, " object"]) -> _Kept:
    tracks, now = scene.tracks, scene.now
    after_s = CLOCK.step_s * np.arange(1, FUTURE_STEPS + 1)
    xyz_m = tracks.xyz_m[rows, now].astype(np.float64) + scene.origin_xyz_m
    velocity_mps = np.pad(tracks.velocity_mps[rows, now], ((0, 0), (0, 1)))
    world_m = xyz_m[:, None] + velocity_mps[:, None] * after_s[:, None]
    heading_rad = np.broadcast_to(tracks.heading_rad[rows, now, None], world_m.shape[:2])
    values = np.concatenate([np.moveaxis(world_m, 2, 0), heading_rad[None]])
    return _Kept(tracks.id[rows].astype(np.int64), values.astype(np.float32))


def _join(played: Rollouts, kept: _Kept, order: Int64[np.ndarray, " object"]) -> Rollouts:
    """Put played and kept objects in one order."""
    ids = np.concatenate([played.object_id, kept.object_id])
    by_id = np.argsort(ids, kind="stable")
    rows = by_id[np.searchsorted(ids, order, sorter=by_id)]

    def both(values: np.ndarray, axis: int) -> np.ndarray:
        same = np.broadcast_to(kept.values[axis], (len(values), *kept.values.shape[1:]))
        return np.concatenate([values, same], axis=1)[:, rows]

    return Rollouts(
        scenario_id=played.scenario_id,
        object_id=order,
        x_m=both(played.x_m, 0),
        y_m=both(played.y_m, 1),
        z_m=both(played.z_m, 2),
        heading_rad=both(played.heading_rad, 3),
    )
