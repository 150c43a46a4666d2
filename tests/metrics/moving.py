"""Boxes that move as a test says."""

import numpy as np

from infgen.metrics.motion import Motion

STEP_S = 0.1
CAR_LWH_M = (4.0, 2.0, 1.5)


def boxes(*paths, size_lwh_m=CAR_LWH_M, agent_type=0, valid=None, steps=11) -> Motion:
    """One rollout of boxes from (x, y, heading, speed) each, or from poses.

    Poses are [step, 3], or [step, 4] with the height of the centre.
    """
    rows = [_path(path, steps) for path in paths]
    sizes = size_lwh_m if np.ndim(size_lwh_m) == 2 else [size_lwh_m] * len(paths)
    x, y, heading, z = np.moveaxis(np.array(rows, dtype=np.float32), -1, 0)[:, None]
    shown = np.ones(x.shape, bool) if valid is None else np.array(valid, bool)[None]
    return Motion(
        x_m=x,
        y_m=y,
        z_m=z,
        heading_rad=heading,
        size_lwh_m=np.array(sizes, dtype=np.float32),
        agent_type=np.broadcast_to(np.int8(agent_type), len(paths)).copy(),
        valid=shown,
    )


def _path(path, steps):
    path = np.asarray(path, dtype=np.float64)
    if path.ndim == 1:
        x, y, heading, speed = path
        along = speed * STEP_S * np.arange(steps)
        path = np.column_stack(
            [
                x + along * np.cos(heading),
                y + along * np.sin(heading),
                np.full(steps, heading),
            ]
        )
    if path.shape[1] == 3:
        path = np.column_stack([path, np.zeros(len(path))])
    return path
