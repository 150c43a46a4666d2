"""The tables of a comparison: the paper's, with our rows beside the published ones."""

from collections.abc import Sequence
from dataclasses import replace

from infgen.clock import CLOCK
from infgen.views.published import ABLATIONS, CAVEAT, PAPER, Published
from infgen.views.sheets import Measured, Sheet, SheetCell
from pipeline.comparison.claims import PROTOCOLS, claims
from pipeline.comparison.learning_curve import learning_curve
from pipeline.comparison.proper import proper
from pipeline.comparison.result import LONG, MOTION_ONLY, OFFICIAL_PLAY, ComparisonResult
from pipeline.comparison.rules import rules, rules_in_tables
from pipeline.comparison.statistics import truth
from pipeline.engine.layout import KEY_DIGITS
from pipeline.settings.presets import Arm
from pipeline.stages.report.tables import BUCKETS, COMPOSITES, PLACEMENT
from pipeline.storage.scenes import file_name

COMPOSITE, WITHOUT_PLACEMENT = COMPOSITES
RUNS = "runs"
_MOVING = [name for name in BUCKETS if name != "placement"]
_WOSAC = {
    "wosac/metametric": "composite",
    "wosac/kinematic_metrics": "kinematic",
    "wosac/interactive_metrics": "interactive",
    "wosac/map_based_metrics": "map",
    "wosac/min_average_displacement_error": "minADE, m",
}
_COUNT_ERRORS = {
    "own": "the scene's own log in its first window, as in the paper",
    "split": "the mean of the split's logs",
    "truth": "the same moment of the scene's own log",
}


def tables(found: ComparisonResult) -> list[Sheet]:
    """All tables that there are numbers for, split by split."""
    drawn = [
        _of_split(sheet, split)
        for split, part in found.by_split.items()
        for sheet in _compared(part)
    ]
    return [sheet for sheet in [*drawn, runs(found)] if sheet.rows]


def _compared(found: ComparisonResult) -> list[Sheet]:
    return [
        claims(found),
        short_term(found),
        long_term(found),
        motion_only(found),
        proper(found),
        learning_curve(found),
        ablations(found),
        against_logs(found),
        rules(found),
    ]


def _of_split(sheet: Sheet, split: str) -> Sheet:
    """Name the split of a table, where there are several."""
    if not split:
        return sheet
    name, title = f"{sheet.name}-{file_name(split)}", f"{sheet.title} ({split})"
    return replace(sheet, name=name, title=title)


def caveats(found: ComparisonResult) -> list[str]:
    """What must be known of all the tables."""
    told = found.interval[0].upper() + found.interval[1:]
    return [f"{told} (half of it behind ±).", *rules_in_tables(found), CAVEAT]


def standing_alone(found: ComparisonResult, sheet: Sheet) -> Sheet:
    """Let a table say itself what must be known of all."""
    if sheet.name == RUNS:
        return sheet
    return replace(sheet, note=" ".join([sheet.note, *caveats(found)]).strip())


def short_term(found: ComparisonResult) -> Sheet:
    """Table 1: eight seconds by Waymo's metric."""
    names = list(_WOSAC)
    ours = [
        [f"{label}, ours", *[numbers.get(name) for name in names]]
        for label, numbers in found.rows(found.methods, OFFICIAL_PLAY)
    ]
    theirs = [
        [f"{each.method}, published", *each.short_term.values(), None]
        for each in _published(found)
    ]
    played = [one for one in found.scored if one.mode == OFFICIAL_PLAY]
    counts = sorted({f"{one.metric}: {one.official} of {one.scenes}" for one in played})
    return Sheet(
        name="table-1-short-term",
        title="Table 1: eight seconds by Waymo's metric",
        columns=["method", *_WOSAC.values()],
        rows=[*theirs, *ours] if ours else [],
        note=f"Scenes that the metric could score, by {'; '.join(counts)}.",
    )


def long_term(found: ComparisonResult) -> Sheet:
    """Table 2: agents come and go for 30 s."""
    names = [COMPOSITE, *BUCKETS, *PLACEMENT]
    theirs: list[list[SheetCell]] = [
        [
            f"{each.method}, published",
            *[each.long_term[name] for name in names],
            each.mean_ace,
            each.ace_slope,
        ]
        for each in _published(found)
    ]
    rows = _by_protocol(found, found.methods, LONG, names)
    return Sheet(
        name="table-2-long-term",
        title="Table 2: long-term, agents come and go",
        columns=["method", *[_WORDS[name] for name in names], "Mean ACE", "ACE slope"],
        rows=[*theirs, *rows] if rows else [],
        note=f"Count errors are against {_COUNT_ERRORS[found.preset.count_error]}.",
    )


def motion_only(found: ComparisonResult) -> Sheet:
    """Table 3: motion only, the same length."""
    theirs: list[list[SheetCell]] = [
        [f"{each.method}, published", *each.motion_only.values()]
        for each in _published(found)
    ]
    names = [WITHOUT_PLACEMENT, *_MOVING]
    rows = _by_protocol(found, found.methods, MOTION_ONLY, names, count_errors=False)
    return Sheet(
        name="table-3-motion-only",
        title="Table 3: long-term, motion only",
        columns=["method", "composite", *_MOVING],
        rows=[*theirs, *rows] if rows else [],
    )


def ablations(found: ComparisonResult) -> Sheet:
    """Table 5: the method with something left out."""
    left_out = [arm for arm in found.arms if arm.ablates is not None]
    whole = {arm.ablates for arm in left_out}
    arms = [arm for arm in found.arms if arm.name in whole] + left_out
    names = [COMPOSITE, *BUCKETS]
    theirs: list[list[SheetCell]] = [
        [f"{arm.published}, published", *ABLATIONS[arm.published].values(), None, None]
        for arm in arms
        if arm.published in ABLATIONS
    ]
    rows = _by_protocol(found, arms, LONG, names) if left_out else []
    return Sheet(
        name="table-5-ablations",
        title="Table 5: ablations, long-term",
        columns=["method", *[_WORDS[name] for name in names], "Mean ACE", "ACE slope"],
        rows=[*theirs, *rows] if rows else [],
        note=f"Count errors are against {_COUNT_ERRORS[found.preset.count_error]}.",
    )


def against_logs(found: ComparisonResult) -> Sheet:
    """How many come, go and are there, beside the logs of the same scenes."""
    rates = {"corrected/entry_rate": "entries", "corrected/exit_rate": "exits"}
    shares = {
        "agents/near": "agents near the ego",
        "corrected/collision_rate": "collision rate",
        "corrected/offroad_rate": "off-road rate",
        "corrected/inserted_offroad_rate": "inserted agents' off-road rate",
    }
    logged = {name: truth(found.logs, name) for name in (*rates, *shares)}
    columns = ["method"]
    for label in rates.values():
        columns += [f"{label} per half second", f"{label}, % off"]
    rows: list[list[SheetCell]] = []
    for label, numbers in found.rows(found.arms, LONG):
        cells: list[SheetCell] = [label]
        for name in rates:
            one = numbers.get(name, Measured(None))
            cells += [one.scaled(CLOCK.token_s), _percent_off(one.mean, logged[name])]
        rows.append([*cells, *[numbers.get(name) for name in shares]])
    logs: list[SheetCell] = ["the logs of these scenes"]
    for name in rates:
        logs += [Measured(logged[name]).scaled(CLOCK.token_s).mean, None]
    return Sheet(
        name="against-the-logs",
        title="Compared with the logs: entries, exits and agent counts",
        columns=[*columns, *shares.values()],
        rows=[[*logs, *[logged[name] for name in shares]], *rows] if rows else [],
        note="Entries and exits within 75 m of the ego, over the whole rollout and the "
        "whole log. Rates of collisions and off-road: of the agents and windows, those in "
        "which it happens (corrected protocol).",
    )


def runs(found: ComparisonResult) -> Sheet:
    """Every run with the keys that its numbers can be traced by."""
    scored = {id(one.ran): one for one in found.scored}
    rows: list[list[SheetCell]] = []
    for ran in found.ran:
        one = scored.get(id(ran))
        weights = one.weights[:KEY_DIGITS] if one else None
        counts = (one.scenes, one.rollouts) if one else (None, None)
        on = one.rules if one else None
        score = ran.keys.get("score", "")[:KEY_DIGITS] or None
        why = "" if ran.is_whole else ran.why
        rows.append([ran.arm_run.words, *counts, on, weights, score, why])
    return Sheet(
        name=RUNS,
        title="Runs",
        columns=[
            *("run", "scenes", "rollouts", "rules", "weights"),
            *("key of the scores", "missing"),
        ],
        rows=rows,
        note="`infgen show KEY` shows how anything was made; all keys and numbers are in "
        "comparison.json.",
    )


def _by_protocol(
    found: ComparisonResult,
    arms: Sequence[Arm],
    mode: str,
    names: Sequence[str],
    *,
    count_errors: bool = True,
) -> list[list[SheetCell]]:
    """Rows of ours by each protocol, and of the logs that were continued."""
    ace = f"{found.preset.count_error}_near"
    errors = [f"ace/{ace}", f"ace_slope/{ace}"] if count_errors else []
    rows: list[list[SheetCell]] = []
    for protocol in PROTOCOLS:
        own = [f"{protocol}/{name}" for name in names]
        played: list[list[SheetCell]] = [
            [f"{label}, ours ({protocol})", *[numbers.get(name) for name in own + errors]]
            for label, numbers in found.rows(arms, mode)
        ]
        if played:
            logged = [truth(found.logs, name) for name in own]
            rows += [*played, [f"the logs ({protocol})", *logged, *[None for _ in errors]]]
    return rows


_WORDS = {**COMPOSITES, **BUCKETS, **PLACEMENT}


def _published(found: ComparisonResult) -> list[Published]:
    """Rows of the paper that our methods stand beside; all, where none does."""
    names = {arm.published for arm in found.arms}
    return [each for each in PAPER if each.method in names] or list(PAPER)


def _percent_off(value: float | None, true: float | None) -> float | None:
    if value is None or not true:
        return None
    return 100 * (value / true - 1)
