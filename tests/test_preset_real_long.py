"""Preset ``real-long`` end to end, on small made files of three sources."""

import json
import os
import sys
from pathlib import Path

import polars as pl
import pytest

from cli import main
from infgen.sources.registry import find_below
from infgen.sources.womd_write import encode_scenario, write_tfrecord

pytestmark = pytest.mark.slow

TINY = (
    *("--profile", "tiny", "--seeds", "1", "--dask", "none"),
    *("-s", "train.steps=1", "-s", "train.batch_scenes=2", "-s", "rollout.count=2"),
    *("-s", "train.checkpoint_every_steps=0", "-s", "score.bootstrap_resamples=20"),
    *("-s", "train.source_share=argoverse2:1,scenarionet:1"),
)
SPLITS = ("validation.argoverse2", "validation.scenarionet", "*_20s")


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The folder of the comparison."""
    folder = tmp_path_factory.mktemp("real-long")
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    from other_sources import write_all  # noqa: PLC0415

    write_all(folder / "made")
    logs = [found.read().scene for found in find_below(str(folder / "made/scenarionet"))]
    records = folder / "made/training_20s.tfrecord-00000-of-00001"
    write_tfrecord(records, [encode_scenario(log) for log in logs[-1:]])
    before = Path.cwd()
    os.chdir(folder)
    names = ("made/av2/sensor", "made/scenarionet", str(records))
    words = [word for name in names for word in ("--records", name)]
    try:
        with pytest.raises(SystemExit) as left:
            main(["run", "report", "--preset", "real-long", "--root", "R", *words, *TINY])
    finally:
        os.chdir(before)
        sys.path.pop(0)
    assert not left.value.code
    return folder / "R/presets/real-long"


def test_every_source_has_tables_of_all_three_methods(shown):
    tables = json.loads((shown / "tables.json").read_text())

    for split, name in zip(SPLITS, (*SPLITS[:2], "_20s"), strict=True):
        for kind in ("claims", "table-1-short-term", "table-2-long-term", "proper"):
            assert tables[f"{kind}-{name}"]["title"].endswith(f"({split})")
            assert (shown / "tables" / f"{kind}-{name}.csv").stat().st_size > 0
        rows = [row[0] for row in tables[f"table-2-long-term-{name}"]["rows"]]
        for label in ("InfGen", "SMART", "CatK"):
            assert f"{label}, ours (corrected)" in rows
    assert len(tables["runs"]["rows"]) == 3 * 6


def test_counts_are_held_against_the_truth_beyond_nine_seconds(shown):
    told = json.loads((shown / "comparison.json").read_text())

    assert told["missing"] == []
    for rollout_set in ("argoverse2", "scenarionet", "womd-20s"):
        numbers = told["arms"]["infgen"][rollout_set]
        assert numbers["ace/truth_near"]["mean"] is not None
        assert numbers["proper/energy"]["mean"] is not None
    curves = pl.read_csv(shown / "tables/curves.csv")
    truth = curves.filter(pl.col("metric") == "ace/truth_near").drop_nulls()
    assert truth["middle of the window, s"].max() > 9


def test_eight_seconds_are_scored_without_the_lights_that_the_sources_lack(shown):
    numbers = json.loads((shown / "comparison.json").read_text())["arms"]["infgen"]

    dark = numbers["argoverse2-wosac"]
    assert dark["wosac/metametric"]["mean"] is not None
    assert dark["wosac/traffic_light_violation_likelihood"]["mean"] is None
    lit = numbers["womd-20s-wosac"]
    assert lit["wosac/traffic_light_violation_likelihood"]["mean"] is not None
