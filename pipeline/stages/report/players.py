"""Player pages of the rollouts with the lowest scores, linked from the report."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pipeline.engine.atomic import write_file
from pipeline.engine.stage import FinishedUnit, Inputs

if TYPE_CHECKING:
    from infgen.rollout.rollout import Rollout
    from infgen.scene import Scene


class Place(NamedTuple):
    """Units that hold a rollout, and the log it goes on from."""

    played: FinishedUnit
    logged: FinishedUnit


def write_players(
    inputs: Inputs, target: Path, lowest: Sequence[tuple[str, int, float]], most: int
) -> list[str]:
    """Write players of the first of some rollouts.

    Args:
        inputs: Finished stages.
        target: Folder of the report.
        lowest: Scenario id, index and score of rollouts.
        most: Players to write.

    Returns:
        The page of each of ``lowest``, relative to the report; empty for those without.
    """
    from infgen.views.player import player_page  # noqa: PLC0415
    from infgen.views.scene.view_model import make_view_model  # noqa: PLC0415
    from pipeline.storage.scenes import file_name  # noqa: PLC0415

    shown = [scenario_id for scenario_id, *_ in lowest] if most else []
    places = dict(_places(inputs, shown)) if shown else {}
    pages: list[str] = []
    for scenario_id, index, _ in lowest:
        if len(pages) == most or scenario_id not in places:
            break
        scene, rollout = _read(places[scenario_id], scenario_id, index)
        pages.append(f"players/{file_name(scenario_id)}-{index}.html")
        (target / "players").mkdir(exist_ok=True)
        page = player_page(make_view_model(scene, (rollout,)))
        write_file(target / pages[-1], page.encode())
    return [*pages, *[""] * (len(lowest) - len(pages))]


def _places(inputs: Inputs, scenes: Sequence[str]) -> Iterator[tuple[str, Place]]:
    """Where the rollouts of some scenes are, and their logs: from the index of all."""
    import polars as pl  # noqa: PLC0415

    logs = {done.name: done for done in inputs.units("ingest")}
    rollouts = {done.name: done for done in inputs.units("rollout")}
    found = (
        pl.scan_parquet(inputs.folder("rollout") / "index.parquet")
        .filter(pl.col("scenario_id").is_in(scenes))
        .select("scenario_id", "unit")
        .unique(maintain_order=True)
        .collect()
    )
    for scenario_id, unit in found.iter_rows():
        log = logs.get(unit.rsplit("-", 1)[0])
        if log is not None:
            yield scenario_id, Place(rollouts[unit], log)


def _read(place: Place, scenario_id: str, index: int) -> "tuple[Scene, Rollout]":
    from pipeline.storage.rollouts import read_rollouts  # noqa: PLC0415
    from pipeline.storage.scenes import read_scenes  # noqa: PLC0415

    rollout = next(
        one
        for one in read_rollouts(place.played.path)
        if (one.scenario_id, one.index) == (scenario_id, index)
    )
    scenes = read_scenes(place.logged.path)
    scene = next(one for one in scenes if one.scenario_id == scenario_id)
    return scene, rollout
