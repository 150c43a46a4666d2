import gzip
from dataclasses import replace

import pytest

from infgen.config import IngestSettings
from infgen.errors import ConfigError
from infgen.scene import Scene
from infgen.sources.tfrecord import RecordError, iter_records
from infgen.sources.towns import builtin_records
from infgen.sources.womd import decode_scene, read_scenario_id
from pipeline.engine.stage import Unit
from pipeline.stages import ingest
from pipeline.storage import scene_lookup
from pipeline.storage.scene_lookup import (
    MissingSceneError,
    RecordLookup,
    StoreLookup,
    open_scene_lookup,
    open_split,
    unit_folders,
)
from pipeline.storage.sources.fingerprints import fingerprint as file_identity
from pipeline.storage.sources.source_files import RawRecords


def silent(done, total, note=""):
    pass


@pytest.fixture(scope="module")
def source():
    return min(builtin_records(), key=lambda path: path.stat().st_size)


@pytest.fixture(scope="module")
def records(source):
    return {read_scenario_id(one.data): one for one in iter_records(source)}


@pytest.fixture(scope="module")
def ingested(source, tmp_path_factory):
    target = tmp_path_factory.mktemp("ingested") / "unit"
    settings = replace(IngestSettings(), max_scenes_per_shard=2)
    ingest.work(
        Unit(source.name, {"source": file_identity(source)}, {"url": str(source)}),
        target,
        settings,
        silent,
    )
    return target


@pytest.mark.parametrize("cache_bytes", [1 << 30, 0], ids=["all kept", "none kept"])
def test_records_are_found_in_any_order(source, records, cache_bytes):
    found = RecordLookup(RawRecords([str(source)], []), cache_bytes)

    for scenario_id in [*reversed(records), *records]:
        assert found.find(scenario_id).scenario_id == scenario_id


def test_plain_records_are_found_again_by_their_offset(tmp_path, source, records):
    plain = tmp_path / "plain.tfrecord"
    plain.write_bytes(gzip.decompress(source.read_bytes()))
    found = RecordLookup(RawRecords([str(plain)], []), cache_bytes=0)

    for scenario_id in [*reversed(records), *records]:
        assert found.find(scenario_id).scenario_id == scenario_id


def test_records_that_nobody_asks_for_are_not_all_kept(source, records):
    largest = max(len(record.data) for record in records.values())
    found = RecordLookup(RawRecords([str(source)], []), largest)
    found.find(list(records)[-1])

    assert sum(map(len, found._cached.values())) <= largest


def test_ingested_scenes_are_found_in_any_order(ingested, records):
    found = StoreLookup([ingested])

    for scenario_id in [*reversed(records), *records]:
        assert found.find(scenario_id).scenario_id == scenario_id
    assert len(found._open) == scene_lookup.MAX_OPEN_GROUPS


def test_both_hold_the_same_logs(source, ingested, records):
    scenario_id = next(iter(records))
    raw, kept = (
        open_scene_lookup([str(name)]).find(scenario_id) for name in (source, ingested)
    )

    assert isinstance(raw, Scene)
    assert raw.tracks.xyz_m.tobytes() == kept.tracks.xyz_m.tobytes()


def test_a_missing_log_says_how_many_there_are(source, ingested, records):
    with pytest.raises(MissingSceneError, match=f"stray: none of {len(records)} records"):
        open_scene_lookup([str(source)]).find("stray")
    with pytest.raises(MissingSceneError, match=f"scene stray: none of {len(records)} ing"):
        open_scene_lookup([str(ingested)]).find("stray")


def test_a_damaged_record_is_named_where_a_log_is_missing(tmp_path, source, records):
    data = bytearray(gzip.decompress(source.read_bytes()))
    data[500] ^= 1
    damaged = tmp_path / source.name
    damaged.write_bytes(gzip.compress(bytes(data)))

    with pytest.raises(
        MissingSceneError, match=r"1 unusable records: .*record 0: data check"
    ):
        RecordLookup(RawRecords([str(damaged)], [])).find(next(iter(records)))


def test_a_file_without_any_record_is_a_wrong_word(tmp_path):
    path = tmp_path / "x.tfrecord"
    path.write_text("nothing of the kind, and long enough")

    with pytest.raises(ConfigError, match=r"no usable record: .*not a TFRecord"):
        open_scene_lookup([str(path)]).find("any")
    with pytest.raises(ConfigError, match="no records match"):
        open_scene_lookup([str(tmp_path / "*.nothing")])


def test_a_folder_of_records_is_no_store(tmp_path, source, records):
    (tmp_path / source.name).write_bytes(source.read_bytes())

    assert unit_folders(tmp_path) is None
    assert open_scene_lookup([str(tmp_path)]).find(next(iter(records)))


def test_a_store_of_other_things_is_refused(tmp_path):
    (tmp_path / "tokens-000.zarr").mkdir()

    with pytest.raises(ConfigError, match="holds no ingested scenes"):
        open_scene_lookup([str(tmp_path)])


def test_the_id_is_that_of_the_decoded_scene(records):
    for scenario_id, record in records.items():
        assert decode_scene(record.data).scenario_id == scenario_id
    with pytest.raises(RecordError, match="empty"):
        read_scenario_id(b"")


def test_ids_are_those_of_the_records_in_order_and_read_as_far_as_needed(source, records):
    found = RecordLookup(RawRecords([str(source)], []))

    assert list(found.scenario_ids(2)) == list(records)[:2]
    assert list(found.scenario_ids()) == list(records)


def test_a_split_of_a_store_is_chosen_by_its_index(ingested, source, records):
    split = source.name.split(".tfrecord")[0]

    assert list(open_split([str(ingested)], split).scenario_ids()) == list(records)
    assert list(open_split([str(ingested)], None).scenario_ids()) == list(records)
    with pytest.raises(ConfigError, match=f"no split 'other'; there is {split}"):
        open_split([str(ingested)], "other")


def test_a_root_without_scenes_is_told_how_to_make_them(tmp_path):
    (tmp_path / "store").mkdir()

    with pytest.raises(ConfigError, match="holds no scenes; `infgen ingest --root"):
        open_split([str(tmp_path)], None)
