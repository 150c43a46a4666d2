"""What the paper claims: its method as a multiple of others, ours and as published."""

from infgen.views.published import PAPER, Published
from infgen.views.sheets import Measured, Sheet, SheetCell
from pipeline.comparison.result import LONG, MOTION_ONLY, OFFICIAL_PLAY, ComparisonResult
from pipeline.settings.presets import Arm
from pipeline.stages.report.tables import COMPOSITES

PROTOCOLS = ("paper", "corrected")
_COMPOSITE, _WITHOUT_PLACEMENT = COMPOSITES


def claims(found: ComparisonResult) -> Sheet:
    """What the paper claims, as ratios of its method to each other one."""
    subject = found.subject
    others = [arm for arm in found.methods if arm is not subject]
    columns, rows = ["number"], []
    for arm in others:
        pair = f"{subject.label if subject else ''} / {arm.label}"
        columns += [pair, f"{pair}, published"]
    for label, mode, name in _claimed(found):
        cells: list[SheetCell] = []
        for arm in others:
            ours = found.ratio(subject, arm, mode, name) if subject else Measured(None)
            cells += [ours, _published_ratio(subject, arm, mode, name)]
        if any(isinstance(cell, Measured) and cell.mean is not None for cell in cells):
            rows.append([label, *cells])
    return Sheet(
        name="claims",
        title="What is claimed: one method as a multiple of another",
        columns=columns,
        rows=rows,
        note="Of the count error (ACE) less is better, of scores more. Ratios are taken "
        "seed by seed, and intervals with one seed by drawing the same scenes for both.",
    )


def _claimed(found: ComparisonResult) -> list[tuple[str, str, str]]:
    """Rows of the claims: what it is, kind of rollout set, and name of the number."""
    ace = f"{found.preset.count_error}_near"
    rows = [
        ("Mean ACE", LONG, f"ace/{ace}"),
        ("ACE slope", LONG, f"ace_slope/{ace}"),
    ]
    for each in PROTOCOLS:
        rows += [
            (f"placement ({each})", LONG, f"{each}/placement"),
            (f"composite ({each})", LONG, f"{each}/{_COMPOSITE}"),
            (
                f"motion only: composite ({each})",
                MOTION_ONLY,
                f"{each}/{_WITHOUT_PLACEMENT}",
            ),
        ]
    return [*rows, ("eight seconds: composite", OFFICIAL_PLAY, "wosac/metametric")]


def _published_ratio(ours: Arm | None, theirs: Arm, mode: str, name: str) -> float | None:
    """The paper's own ratio of what its protocol, or none, gives."""
    protocol, _, label = name.partition("/")
    if protocol == "corrected" or ours is None:
        return None
    rows = {each.method: each for each in PAPER}
    pair = [rows.get(arm.published or "") for arm in (ours, theirs)]
    values = [_published_number(each, mode, protocol, label) for each in pair if each]
    known = [value for value in values if value is not None]
    return known[0] / known[1] if len(known) == len(pair) else None


def _published_number(
    each: Published, mode: str, protocol: str, label: str
) -> float | None:
    if protocol in ("ace", "ace_slope"):
        return each.mean_ace if protocol == "ace" else each.ace_slope
    if mode == OFFICIAL_PLAY:
        return each.short_term[_COMPOSITE]
    if mode == MOTION_ONLY:
        return each.motion_only[_COMPOSITE]
    return each.long_term.get(label)
