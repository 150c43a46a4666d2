"""Poses in the frames of other poses: what ``infgen.geometry`` does, for tensors."""

import torch
from jaxtyping import Float32
from torch import Tensor


def to_local(
    pose: Float32[Tensor, "*row 3"], frame: Float32[Tensor, "*row 3"]
) -> Float32[Tensor, "*row 3"]:
    """Express world poses in the frame of other poses. Inverse of ``to_world``."""
    away_m = pose[..., :2] - frame[..., :2]
    turn_rad = wrap_angle(pose[..., 2] - frame[..., 2])
    return torch.cat([rotate(away_m, -frame[..., 2]), turn_rad[..., None]], dim=-1)


def to_world(
    pose: Float32[Tensor, "*row 3"], frame: Float32[Tensor, "*row 3"]
) -> Float32[Tensor, "*row 3"]:
    """Bring poses given in the frame of other poses to the world."""
    xy_m = rotate(pose[..., :2], frame[..., 2]) + frame[..., :2]
    heading_rad = wrap_angle(pose[..., 2] + frame[..., 2])
    return torch.cat([xy_m, heading_rad[..., None]], dim=-1)


def wrap_angle(angle_rad: Tensor) -> Tensor:
    """Bring angles to [-pi, pi)."""
    wrapped = torch.remainder(angle_rad + torch.pi, 2 * torch.pi) - torch.pi
    # Rounding may lift an angle just below -pi to exactly +pi.
    return torch.where(wrapped >= torch.pi, -torch.pi, wrapped)


def rotate(xy_m: Tensor, angle_rad: Tensor) -> Tensor:
    """Turn points counter-clockwise about the origin."""
    cos, sin = angle_rad.cos(), angle_rad.sin()
    x_m, y_m = xy_m.unbind(-1)
    return torch.stack([cos * x_m - sin * y_m, sin * x_m + cos * y_m], dim=-1)
