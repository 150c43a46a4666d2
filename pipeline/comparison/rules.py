"""What rules over the network's choices change, and what of them is in the other tables."""

from collections.abc import Mapping

from infgen.clock import CLOCK
from infgen.views.sheets import Measured, Sheet, SheetCell
from pipeline.comparison.result import LONG, MOTION_ONLY, OFFICIAL_PLAY, ComparisonResult
from pipeline.comparison.statistics import truth
from pipeline.settings.presets import Arm

NONE = "none"
_RATES = {
    "corrected/entry_rate": "entries per half second",
    "corrected/exit_rate": "exits per half second",
}
_SHARES = {
    "agents/near": "agents near the ego",
    "corrected/collision_rate": "collision rate",
    "corrected/offroad_rate": "off-road rate",
    "corrected/inserted_offroad_rate": "inserted agents' off-road rate",
}
_COMPOSITES = {
    "corrected/composite": "composite (corrected)",
    "paper/composite": "composite (paper)",
}


def rules(found: ComparisonResult) -> Sheet:
    """What rules change: rollouts of the same weights with rules and without."""
    rows: list[list[SheetCell]] = []
    for base in dict.fromkeys(arm.rules_of for arm in found.rules_arms):
        rows += [_row(found, arm) for arm in found.arms if arm.name == base]
        rows += [_row(found, arm) for arm in found.rules_arms if arm.rules_of == base]
    columns = [
        *("method", "rules", *_RATES.values(), *_SHARES.values(), "Mean ACE", "ACE slope"),
        *(*_COMPOSITES.values(), "motion only: composite", "eight seconds: composite"),
    ]
    return Sheet(
        name="rules",
        title="What rules change: the same weights without rules and with them",
        columns=columns,
        rows=[_logs(found, len(columns)), *rows] if rows else [],
        note="Rules are settings of rollouts (rollout.rules). Entries, exits, agents, "
        "rates, count errors and the first two composites are those of long rollouts; "
        "rates and the composite of motion only those of the corrected protocol.",
    )


def rules_in_tables(found: ComparisonResult) -> list[str]:
    """Say which rules and biases the rollouts of all other tables had, in a sentence."""
    names = {arm.name: arm.label for arm in found.arms}
    scored = [one for one in found.scored if one.arm in names]
    if not scored:
        return []
    ruled = {f"{names[one.arm]}: {one.rules}": None for one in scored if one.rules != NONE}
    biased = {names[one.arm]: None for one in scored if one.biased}
    if not (ruled or biased):
        return [
            "Rollouts are what the networks sample: no rules (rollout.rules=none), no "
            "biases on insertions and removals."
        ]
    return [
        f"Rules over the networks' choices: {'; '.join(ruled) or NONE}. Biases on "
        f"insertions and removals: {', '.join(biased) or NONE}."
    ]


def _row(found: ComparisonResult, arm: Arm) -> list[SheetCell]:
    long, ace = found.first(arm, LONG), f"{found.preset.count_error}_near"
    names = dict.fromkeys(one.rules for one in found.scored if one.arm == arm.name)
    return [
        *(arm.label, "; ".join(names)),
        *[long.get(name, Measured(None)).scaled(CLOCK.token_s) for name in _RATES],
        *[long.get(name) for name in _SHARES],
        *(long.get(f"ace/{ace}"), long.get(f"ace_slope/{ace}")),
        *[long.get(name) for name in _COMPOSITES],
        found.first(arm, MOTION_ONLY).get("corrected/composite_without_placement"),
        found.first(arm, OFFICIAL_PLAY).get("wosac/metametric"),
    ]


def _logs(found: ComparisonResult, width: int) -> list[SheetCell]:
    """The logs of the same scenes, as far as they have these numbers."""
    logged: Mapping[str, float | None] = {
        name: truth(found.logs, name) for name in (*_RATES, *_SHARES)
    }
    rates = [Measured(logged[name]).scaled(CLOCK.token_s).mean for name in _RATES]
    cells = ["the logs of these scenes", None, *rates, *[logged[name] for name in _SHARES]]
    return [*cells, *[None for _ in range(width - len(cells))]]
