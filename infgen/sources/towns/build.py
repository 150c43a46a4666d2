"""Towns drawn at random: a straight road, a bend, a T-junction or a crossing."""

from enum import Enum

import numpy as np

from infgen.sources.towns.arms import Arm, Verge
from infgen.sources.towns.curves import bend
from infgen.sources.towns.kerbside import (
    draw_buildings,
    draw_bumps,
    draw_driveways,
    draw_parked,
)
from infgen.sources.towns.pavements import crosswalks, draw_pavements
from infgen.sources.towns.streets import Control, Draft, draw_kerbs, draw_streets
from infgen.sources.towns.town import SignalPlan, Town

ARM_LENGTH_M = 170.0
_MIDDLE_SPACING_M = 0.5


class Shape(Enum):
    """What kind of place a town is."""

    STRAIGHT = "straight"
    BEND = "bend"
    TEE = "tee"
    CROSSING = "crossing"


_SHARES = {Shape.STRAIGHT: 0.15, Shape.BEND: 0.2, Shape.TEE: 0.25, Shape.CROSSING: 0.4}


def draw_town(rng: np.random.Generator) -> Town:
    """Draw a town."""
    shape = list(_SHARES)[rng.choice(len(_SHARES), p=list(_SHARES.values()))]
    draft = Draft(_arms(shape, rng), _control(shape, rng))
    draw_streets(draft)
    draw_pavements(draft)
    strips = draft.strips()
    return Town(
        strips=strips,
        lines=tuple(draft.lines.values()),
        edges=draw_kerbs(draft.arms),
        crosswalks=crosswalks(draft.arms),
        bumps=draw_bumps(draft.arms, rng),
        driveways=draw_driveways(draft.arms, rng),
        signs=draft.signs(),
        buildings=draw_buildings(draft.arms, strips, rng),
        parked=draw_parked(draft.arms, rng),
        plan=_plan(rng) if draft.control is Control.SIGNALS else None,
    )


def _control(shape: Shape, rng: np.random.Generator) -> Control:
    if shape is Shape.CROSSING:
        return Control.SIGNALS if rng.random() < 0.75 else Control.ALL_STOP
    return Control.MINOR_STOPS if shape is Shape.TEE else Control.NONE


def _plan(rng: np.random.Generator) -> SignalPlan:
    green_s = (float(rng.uniform(11.0, 18.0)), float(rng.uniform(9.0, 15.0)))
    return SignalPlan(green_s, 3.2, 1.6, 5.0, float(rng.uniform(0.0, 40.0)))


def _arms(shape: Shape, rng: np.random.Generator) -> tuple[Arm, ...]:
    """Draw the arms: opposite ones are alike."""
    turn_rad = rng.uniform(0.5, 1.3) * rng.choice([-1, 1])
    angles_rad = {
        Shape.STRAIGHT: np.array([np.pi, 0.0]),
        Shape.BEND: np.array([np.pi, turn_rad]),
        Shape.TEE: np.radians([180, 270, 360]) + rng.normal(0.0, 0.06, 3),
        Shape.CROSSING: np.radians([180, 270, 360, 450]) + rng.normal(0.0, 0.06, 4),
    }[shape]
    streets = [_street(rng, major=True), _street(rng, major=False)]
    alike = [streets[at % 2 if len(angles_rad) > 2 else 0] for at in range(len(angles_rad))]
    mouths_m = _mouths(shape, turn_rad, alike, rng)
    curvature_1pm = rng.uniform(-1, 1, len(angles_rad)) / 320
    one_crosswalk = int(rng.integers(0, 3))  # 2: none
    return tuple(
        Arm(
            middle_m=bend(
                np.array([mouth_m * np.cos(angle), mouth_m * np.sin(angle), angle]),
                ARM_LENGTH_M,
                curvature,
                _MIDDLE_SPACING_M,
            ),
            num_lanes=num_lanes,
            verge=verge,
            limit_mph=limit_mph,
            crosswalk=len(alike) > 2 or at == one_crosswalk,
            lined=lined,
        )
        for at, (
            mouth_m,
            angle,
            curvature,
            (num_lanes, verge, limit_mph, lined),
        ) in enumerate(zip(mouths_m, angles_rad, curvature_1pm, alike, strict=True))
    )


def _street(rng: np.random.Generator, *, major: bool) -> tuple[int, Verge, float, bool]:
    """Draw lanes each way, verge, speed limit and whether the middle is painted."""
    num_lanes = 1 + int(rng.random() < (0.45 if major else 0.1))
    verges = [Verge.BIKE_LANE, Verge.PARKING, Verge.GUTTER]
    verge = verges[rng.choice(3, p=[0.55, 0.25, 0.2])]
    limit_mph = float(rng.choice([25, 30, 35, 40] if major else [20, 25, 30]))
    return num_lanes, verge, limit_mph, major or rng.random() < 0.5


def _mouths(
    shape: Shape,
    turn_rad: float,
    streets: list[tuple[int, Verge, float, bool]],
    rng: np.random.Generator,
) -> list[float]:
    """How far from the centre each arm begins: where the corners have room to turn."""
    if shape is Shape.STRAIGHT:
        return [8.0, 8.0]
    if shape is Shape.BEND:
        return [float(rng.uniform(22.0, 45.0) * np.tan(abs(turn_rad) / 2))] * 2
    corner_m = rng.uniform(6.5, 9.0)
    half_m = [num_lanes * 3.5 + verge.value for num_lanes, verge, _, _ in streets]
    return [1.12 * half_m[(at + 1) % 2] + corner_m for at in range(len(streets))]
