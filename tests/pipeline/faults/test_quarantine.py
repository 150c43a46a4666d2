"""Ten thousand records that cannot be used, in one file and in the report."""

import json
import tracemalloc

import polars as pl
import pytest

from cli import main
from infgen.config import IngestSettings
from infgen.sources.tfrecord import frame
from infgen.sources.womd_write import encode_scenario
from pipeline.engine.layout import Root
from pipeline.engine.stage import Unit
from pipeline.stages.ingest import STAGE
from pipeline.stages.report.passport import MAX_QUARANTINED, _quarantine
from pipeline.storage.sources.fingerprints import fingerprint

BAD = 10_000
BAD_BYTES = 10_000


@pytest.fixture(scope="module")
def path(tmp_path_factory, scenes):
    """A file of so many records with a flipped bit, 100 MB of them, and a good one."""
    bad = bytearray(frame(bytes(BAD_BYTES)))
    bad[BAD_BYTES // 2] ^= 1
    path = tmp_path_factory.mktemp("bad") / "training.tfrecord-0"
    path.write_bytes(bytes(bad) * BAD + frame(encode_scenario(scenes[0])))
    return path


@pytest.mark.slow
def test_memory_does_not_grow_with_what_is_quarantined(path, tmp_path):
    unit = Unit(path.name, {"source": fingerprint(path)}, {"url": str(path)})

    tracemalloc.start()
    report = STAGE.work(unit, tmp_path / "unit", IngestSettings(), lambda *_: None)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert (report["quarantined"], report["scenes"]) == (BAD, 1)
    assert most < BAD * BAD_BYTES / 2, "rows are kept, and not what the records held"


def test_messages_and_pages_name_a_few_and_the_table_all(path, tmp_path, capsys):
    root = Root(tmp_path / "root")

    with pytest.raises(SystemExit) as left:
        main(["ingest", str(path), "--root", str(root.path), "--json"])

    said = capsys.readouterr()
    (made,) = json.loads(said.out)["stages"]
    folder = root.folder("ingest", made["key"])

    class Inputs:
        def folder(self, stage):
            return folder

    page = _quarantine(Inputs())
    assert left.value.code == 3
    assert f"{BAD} of {BAD + 1} records (99.99%) are quarantined" in said.err
    assert "and 9997 more in that table" in said.err
    assert len(said.err) < 3000
    assert len(said.out) < 3000
    assert pl.read_parquet(folder / "quarantine.parquet").height == BAD
    assert len(page.rows) == MAX_QUARANTINED
    assert page.note.startswith(f"{MAX_QUARANTINED} of {BAD}; all are in")
    assert sum(log.stat().st_size for log in root.logs.iterdir()) < 10_000
