"""The table of a comparison by protocol ``proper``."""

from infgen.views.sheets import Measured, Sheet, SheetCell
from pipeline.comparison.result import LONG, ComparisonResult
from pipeline.settings.presets import Arm

_BEFORE = {
    "proper/energy": "energy score",
    "proper/skill_persistence/energy": "skill over as many as now",
    "proper/skill_climatology/energy": "skill over the split's distribution",
}
_AFTER = {
    "proper/skill_persistence/entries": "entries: skill over none",
    "proper/skill_persistence/exits": "exits: skill over none",
    "proper/spread_skill/vehicles": "spread over error, vehicles",
    "proper/context/energy": "energy score, logs of like situations",
    "proper/likelihood/composite": "likelihood of the logs",
    "proper/w1/speed": "speed, W1 in m/s",
    "proper/w1/time_headway": "time headway, W1 in s",
}

SCORES = {**_BEFORE, **_AFTER}
"""Scores that stand in tables: their names, and the words above them."""


def proper(found: ComparisonResult) -> Sheet:
    """Scores that are best for the true distribution, over what log and rollouts share."""
    still = motion_only_arm(found)
    rows: list[list[SheetCell]] = []
    for arm in found.arms:
        for label, numbers in found.rows([arm], LONG):
            cells: list[SheetCell] = [label, *[numbers.get(name) for name in _BEFORE]]
            cells.append(_skill_over(found, arm, still))
            rows.append([*cells, *[numbers.get(name) for name in _AFTER]])
    known = any(
        isinstance(cell, Measured) and cell.mean is not None for row in rows for cell in row
    )
    method = still.label if still else "none was simulated: not measured"
    return Sheet(
        name="proper",
        title="Proper scores: rollouts as forecasts of their logs",
        columns=["method", *_BEFORE.values(), "skill over motion only", *_AFTER.values()],
        rows=rows if known else [],
        note="Energy score and distances (W1): less is better. Skill: 1 is best, 0 as good "
        "as the reference: as many agents as now, the logs of the split, and motion only "
        f"with the radius heuristic ({method}). Spread over error is best at 1.",
    )


def motion_only_arm(found: ComparisonResult) -> Arm | None:
    """Find the method whose agents enter and exit by the radius heuristic alone."""
    for arm in found.arms:
        for runs in found.runs(arm, LONG).values():
            if any(one.settings.presence_radius_m > 0 for one in runs):
                return arm
    return None


def _skill_over(found: ComparisonResult, arm: Arm, reference: Arm | None) -> SheetCell:
    """Give one less the ratio of the energy scores; nothing for the reference itself."""
    if reference is None or arm is reference:
        return None
    ratio = found.ratio(arm, reference, LONG, "proper/energy")
    ends = ratio.mean, ratio.high, ratio.low
    return Measured(*[None if end is None else 1 - end for end in ends])
