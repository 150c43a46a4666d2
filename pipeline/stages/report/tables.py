"""The tables of the report, from what ``score`` summed up and the paper published."""

from collections.abc import Mapping, Sequence
from typing import Any

from infgen.views.published import CAVEAT, PAPER, Published
from infgen.views.tables import Cell, Table, words

COMPOSITES = {
    "composite": "composite",
    "composite_without_placement": "composite without placement",
}
BUCKETS = {
    "kinematic": "kinematic",
    "interactive": "interactive",
    "map": "map",
    "placement": "placement",
}
PLACEMENT = {
    "num_entries": "entries per half second",
    "num_exits": "exits per half second",
    "entry_distance": "distance at entry",
    "exit_distance": "distance at exit",
}
FEATURES = {
    "linear_speed": "speed",
    "linear_acceleration": "acceleration",
    "angular_speed": "turning speed",
    "angular_acceleration": "turning acceleration",
    "distance_to_nearest_object": "distance to nearest",
    "collision_indication": "collision",
    "time_to_collision": "time to collision",
    "distance_to_road_edge": "distance to road edge",
    "offroad_indication": "off-road",
    **PLACEMENT,
}
"""Words for the scores that the long-term metric knows."""
NUMBERS = {
    "ace/own_near": "Mean ACE, own log, near",
    "ace_slope/own_near": "ACE slope, own log, near",
    "ace/own_all": "Mean ACE, own log, all",
    "ace_slope/own_all": "ACE slope, own log, all",
    "ace/split_near": "Mean ACE, split mean, near",
    "ace/truth_near": "Mean ACE, later truth, near",
    "agents/near": "agents near the ego",
    "agents/all": "agents",
    "rate/entries": "entries per second",
    "rate/exits": "exits per second",
    "corrected/collision_rate": "collision rate",
    "corrected/offroad_rate": "off-road rate",
}
"""Words for the other numbers."""
PROPER = {
    "energy": "energy score of counts (proper)",
    "skill_persistence/energy": "skill over as many as now (proper)",
    "skill_climatology/energy": "skill over the split's distribution (proper)",
    "context/energy": "energy score, logs of like situations (proper)",
    "spread_skill/vehicles": "spread over error, vehicles (proper)",
    "likelihood/composite": "likelihood of the logs (proper)",
}
"""Words for the numbers of protocol ``proper`` that stand among all scores."""
_PAPER_ACE = {"ace/own_near": "mean_ace", "ace_slope/own_near": "ace_slope"}


def score_table(summary: Mapping[str, Any]) -> Table:
    """The table of scores: a row per number, the log's own and published ones beside it."""
    rows: list[list[Cell]] = []
    for protocol in summary["protocols"]:
        for name, label in {**COMPOSITES, **BUCKETS, **PLACEMENT}.items():
            entry = summary["protocols"][protocol]["scores"].get(name)
            known = protocol == "paper" and name in PAPER[0].long_term
            beside = [each.long_term[name] if known else None for each in PAPER]
            if entry is not None and (name not in PLACEMENT or protocol == "paper"):
                rows.append([f"{label} ({protocol})", *_cells(entry), *beside])
    for name, label in NUMBERS.items():
        entry = summary["numbers"].get(name)
        if entry is not None and entry["mean"] is not None:
            beside = [_published_ace(each, name) for each in PAPER]
            rows.append([label, *_cells(entry), *beside])
    proper = summary.get("proper", {}).get("numbers", {})
    for name, label in PROPER.items():
        if name in proper and proper[name]["mean"] is not None:
            rows.append([label, *_cells(proper[name]), *[None for _ in PAPER]])
    official = summary["wosac"]
    for name, label in (("metametric", official["version"]), (_MIN_ADE, "minADE, m")):
        if name in official["scores"]:
            rows.append([label, *_cells(official["scores"][name]), None, None, None])
    return Table(
        title="Scores",
        columns=[
            "score",
            "rollouts",
            "95 % interval",
            "log",
            *(f"published {each.method}" for each in PAPER),
        ],
        rows=rows,
        note=_about(summary),
    )


_MIN_ADE = "min_average_displacement_error"


def long_term_table(summary: Mapping[str, Any], *, motion_only: bool) -> Table:
    """The paper's table 2 (or 3, motion only) with our rows below the published ones."""
    number = 3 if motion_only else 2
    names = ["composite", *BUCKETS, *PLACEMENT]
    if motion_only:
        names = ["composite", *[name for name in BUCKETS if name != "placement"]]
    rows: list[list[Cell]] = []
    for each in PAPER:
        found = each.motion_only if motion_only else each.long_term
        ace: list[Cell] = [None, None] if motion_only else [each.mean_ace, each.ace_slope]
        rows.append([f"{each.method}, published", *[found[name] for name in names], *ace])
    for protocol, part in summary["protocols"].items():
        for label, field in (
            (f"ours ({protocol})", "mean"),
            (f"the log ({protocol})", "log"),
        ):
            ours = [_score(part["scores"], name, field, motion_only) for name in names]
            errors = [_entry(summary["numbers"], name, field) for name in _PAPER_ACE]
            rows.append([label, *ours, *errors])
    columns = ["method", *[(FEATURES | BUCKETS).get(name, name) for name in names]]
    return Table(
        title=f"Beside the paper's table {number}",
        columns=[*columns, "Mean ACE", "ACE slope"],
        rows=rows,
        note=CAVEAT,
    )


def short_term_table(summary: Mapping[str, Any]) -> Table:
    """The paper's table 1 with our official scores below."""
    official = summary["wosac"]
    rows: list[list[Cell]] = [
        [f"{each.method}, published", *each.short_term.values()] for each in PAPER
    ]
    names = ("metametric", "kinematic_metrics", "interactive_metrics", "map_based_metrics")
    ours = [_entry(official["scores"], name, "mean") for name in names]
    rows.append([f"ours ({official['version']})", *ours])
    skipped = official["skipped"]["count"]
    return Table(
        title="Beside the paper's table 1: eight seconds by Waymo's metric",
        columns=["method", "composite", "kinematic", "interactive", "map"],
        rows=rows,
        note=f"{official['scenes']} scenes scored, {skipped} could not be: the metric asks "
        "for every agent in all eight seconds. " + _left_out(official) + CAVEAT,
    )


def _left_out(official: Mapping[str, Any]) -> str:
    """Say what the metric could not measure, and in how many scenes."""
    needs = {_RED_LIGHTS: "red lights", _OFF_ROAD: "road edges"}
    counts = official["not_measured"]
    told = [f"{what} in {counts[name]}" for name, what in needs.items() if name in counts]
    return f"Not measured: {' and '.join(told)} of them. " if told else ""


_RED_LIGHTS = "traffic_light_violation_likelihood"
_OFF_ROAD = "offroad_indication_likelihood"


def divergence_table(summary: Mapping[str, Any]) -> Table:
    """How far pooled rollouts are from pooled logs, feature by feature."""
    protocols = summary["protocols"]
    rows: list[list[Cell]] = [
        [label, *[protocols[each]["divergence"].get(name) for each in protocols]]
        for name, label in FEATURES.items()
    ]
    return Table(
        title="Jensen-Shannon divergence between rollouts and logs",
        columns=["feature", *protocols],
        rows=rows,
        note="0 where both are distributed alike. A likelihood alone is greatest for "
        "rollouts that collapse to what is most common; this is not.",
    )


def worst_table(rows: Sequence[tuple[str, int, float]], pages: Sequence[str]) -> Table:
    """The rollouts with the lowest scores, and their player pages."""
    return Table(
        title="Lowest composites (corrected)",
        columns=["scene", "rollout", "composite"],
        rows=[list(row) for row in rows],
        links=pages,
    )


def _score(
    scores: Mapping[str, Any], name: str, field: str, motion_only: bool
) -> float | None:
    alone = motion_only and name == "composite"
    return _entry(scores, "composite_without_placement" if alone else name, field)


def _entry(entries: Mapping[str, Any], name: str, field: str) -> float | None:
    value: float | None = entries.get(name, {}).get(field)
    return value


def _cells(entry: Mapping[str, float | None]) -> list[Cell]:
    low, high = entry["low"], entry["high"]
    known = low is not None and high is not None
    return [
        entry["mean"],
        f"{words(low)} to {words(high)}" if known else None,
        entry.get("log"),
    ]


def _published_ace(each: Published, name: str) -> float | None:
    field = _PAPER_ACE.get(name)
    value: float | None = getattr(each, field) if field else None
    return value


def _about(summary: Mapping[str, Any]) -> str:
    return (
        f"Means over {summary['scenes']} scenes ({summary['rollouts']} rollouts), windows "
        f"of {summary['window_s']:g} s every {summary['stride_s']:g} s; near means within "
        f"{summary['count_radius_m']:g} m of the ego. Reference: {summary['logs']} logs, "
        "whose own scores are the ceiling to aim at. Published: by the paper. "
        "A dash: not measured."
    )
