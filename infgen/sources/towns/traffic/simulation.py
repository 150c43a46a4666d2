"""SUMO plays the traffic of a town, and we read who was where."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float64

from infgen.clock import CLOCK
from infgen.sources.towns.sumo import SumoError, run_program, run_stepwise
from infgen.sources.towns.traffic.inattention import InattentiveDrivers
from infgen.sources.towns.variety import Inattention

LATERAL_M = 0.8
"""Lanes are cut into strips so wide: lane changes then take time, and bodies a width."""
IMPATIENT_S = 30
"""Who has waited for so long takes the next gap, however small."""
STUCK_S = 60
"""Who cannot move for so long is taken off the road."""
_MOST_SEED = 1 << 31
NUM_COLUMNS = 6


@dataclass(frozen=True, slots=True)
class Played:
    """Where everyone was. Rows are trips, columns steps from the start of the recording.

    Attributes:
        front_m: Position of the front bumper, of walkers the middle; 0 where not there.
        heading_rad: As SUMO has it: along the lane.
        speed_mps: Along the lane.
        present: Whether they were on the road.
    """

    front_m: Float64[np.ndarray, "trip step 2"]
    heading_rad: Float64[np.ndarray, "trip step"]
    speed_mps: Float64[np.ndarray, "trip step"]
    present: Bool[np.ndarray, "trip step"]


def play(
    net: Path,
    routes: Path,
    num_trips: int,
    most_vehicles: int,
    start_s: float,
    num_steps: int,
    seed: int,
    inattention: Inattention | None = None,
) -> Played:
    """Play a town's traffic and record it from some time on.

    Args:
        net: SUMO's net.
        routes: Its route file.
        num_trips: How many the route file has.
        most_vehicles: While there are so many nobody drives into town.
        start_s: When the recording begins.
        num_steps: How long it is.
        seed: Of SUMO's draws.
        inattention: Which drivers do not look ahead, and when; None if all do.

    Raises:
        SumoError: if SUMO fails.
    """
    folder = routes.parent
    tables = {
        "fcd-output": folder / "driven.csv",
        "person-fcd-output": folder / "walked.csv",
    }
    options: dict[str, object] = {
        "net-file": net,
        "route-files": routes,
        "begin": 0,
        "end": f"{start_s + num_steps * CLOCK.step_s:.1f}",
        "step-length": CLOCK.step_s,
        "lateral-resolution": LATERAL_M,
        "time-to-impatience": IMPATIENT_S,
        "time-to-teleport": STUCK_S,
        "time-to-teleport.remove": True,
        "collision.action": "none",
        "max-depart-delay": 10,
        "max-num-vehicles": most_vehicles,
        "precision": 3,
        "device.fcd.begin": f"{start_s:.1f}",
        "fcd-output.attributes": "id,x,y,angle,speed",
        "output.column-header": "plain",
        "no-step-log": True,
        "duration-log.disable": True,
        "no-warnings": True,
        "seed": seed % _MOST_SEED,
    }
    if inattention is None:
        run_program("sumo", options | tables)
    else:
        first = round(start_s / CLOCK.step_s)
        drivers = partial(_inattentive, inattention, first, seed)
        run_stepwise(options | tables, first + num_steps, drivers)
    return _gather([_read(path) for path in tables.values()], num_trips, start_s, num_steps)


def _inattentive(
    inattention: Inattention, first: int, seed: int, sumo: ModuleType
) -> Callable[[int], None]:
    """Watch over drivers who do not look ahead."""
    return InattentiveDrivers(sumo, inattention, first, seed).before_step


def _read(path: Path) -> Float64[np.ndarray, "row 6"]:
    """Read a table of time, name, x, y, angle and speed."""
    try:
        with path.open("rb") as file:
            next(file, None)
            # Of a step with nobody there, there is a row without values.
            rows = [row for row in file if b";" in row and b";;" not in row]
    except OSError as error:
        raise SumoError(f"sumo wrote no {path.name}: {error}") from error
    if not rows:
        return np.empty((0, NUM_COLUMNS))
    return np.loadtxt(rows, delimiter=";", ndmin=2)


def _gather(
    tables: list[Float64[np.ndarray, "_ 6"]],
    num_trips: int,
    start_s: float,
    num_steps: int,
) -> Played:
    """Lay rows of tables out by trip and step."""
    time_s, name, x_m, y_m, angle_deg, speed_mps = np.concatenate(tables).T
    step = np.round((time_s - start_s) / CLOCK.step_s).astype(np.int64)
    row = name.astype(np.int64)
    kept = (step >= 0) & (step < num_steps)
    at = row[kept], step[kept]
    front_m = np.zeros((num_trips, num_steps, 2))
    front_m[at] = np.column_stack([x_m, y_m])[kept]
    heading_rad, speed = np.zeros((2, num_trips, num_steps))
    # SUMO counts degrees clockwise from north.
    heading_rad[at] = np.deg2rad(90.0 - angle_deg[kept])
    speed[at] = speed_mps[kept]
    present = np.zeros((num_trips, num_steps), bool)
    present[at] = True
    return Played(front_m, heading_rad, speed, present)
