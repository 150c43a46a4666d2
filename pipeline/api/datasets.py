"""Rollouts as one dataset of xarray (extra ``xarray``)."""

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from infgen.clock import CLOCK
from infgen.errors import MissingExtraError
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene

if TYPE_CHECKING:
    import xarray as xr

_STATES = ("x_m", "y_m", "z_m", "heading_rad")
NO_AGENT = -1
"""Track id of a row that no agent has."""


def to_dataset(rollouts: Sequence[Rollout], scene: Scene) -> "xr.Dataset":
    """Lay rollouts out as arrays ``[rollout, agent, step]``, world frame.

    Raises:
        MissingExtraError: if xarray is not installed.
    """
    try:
        xarray = import_module("xarray")
    except ImportError as error:
        raise MissingExtraError(
            f"to_xarray needs xarray: pip install 'infgen[xarray]' ({error})"
        ) from error
    agents = max(len(one.id) for one in rollouts)
    steps = max(one.num_steps for one in rollouts)
    values = np.full((len(_STATES), len(rollouts), agents, steps), np.nan)
    valid = np.zeros((len(rollouts), agents, steps), dtype=bool)
    size_m = np.full((len(rollouts), agents, 3), np.nan, dtype=np.float32)
    about = np.full((3, len(rollouts), agents), NO_AGENT, dtype=np.int32)
    for at, one in enumerate(rollouts):
        rows, span = slice(0, len(one.id)), slice(0, one.num_steps)
        world_m = one.xyz_m.astype(np.float64) + one.origin_xyz_m
        states = [*np.moveaxis(world_m, -1, 0), one.heading_rad.astype(np.float64)]
        values[:, at, rows, span] = np.where(one.valid, np.stack(states), np.nan)
        valid[at, rows, span] = one.valid
        size_m[at, rows] = one.size_lwh_m
        about[:, at, rows] = one.id, one.agent_type, one.logged
    dims, per_agent = ("rollout", "agent", "step"), ("rollout", "agent")
    dataset: xr.Dataset = xarray.Dataset(
        {
            **{name: (dims, part) for name, part in zip(_STATES, values, strict=True)},
            "valid": (dims, valid),
            "id": (per_agent, about[0]),
            "agent_type": (per_agent, about[1].astype(np.int8)),
            "is_logged": (per_agent, about[2] == 1),
            **{
                name: (per_agent, size_m[..., at])
                for at, name in enumerate(("length_m", "width_m", "height_m"))
            },
        },
        coords={
            "rollout": [one.index for one in rollouts],
            "time_s": ("step", np.round(CLOCK.step_s * (np.arange(steps) - scene.now), 3)),
        },
        attrs={"scenario_id": scene.scenario_id, "now": scene.now},
    )
    return dataset
