from pathlib import Path

import pytest

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.errors import ConfigError
from infgen.model.network import Network
from infgen.settings import build, key_values
from pipeline.engine.plan import SOURCES, stages_in_order
from pipeline.engine.registry import MODULES, load_stage
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages

OWN_FILE = Path(__file__).parents[3] / "stages.yaml"
GOOD = """\
version: 1
sources: ${RECORDS:-data/*.tfrecord}
stages:
  ingest: {deps: [sources], params: [ingest]}
  train:
    deps: [ingest]
    params: [model, train]
params:
  train: {learning_rate: 5e-4, steps: 10}
profiles:
  small:
    sources: [one.tfrecord, two.tfrecord]
    train: {steps: 3}
  plain: {}
"""


@pytest.fixture
def load(tmp_path):
    def build(text=GOOD, environ=None):
        path = tmp_path / "stages.yaml"
        path.write_text(text)
        return load_stages(path, environ or {})

    return build


def values(overlay):
    return {
        f"{section}.{key}": value.value
        for section, given in overlay.values.items()
        for key, value in given.items()
    }


def test_the_packaged_file_is_the_repositorys():
    assert DEFAULT_FILE.read_bytes() == OWN_FILE.read_bytes()


def test_the_packaged_file_loads_and_lists_every_stage_in_order():
    file = load_stages(DEFAULT_FILE, {})

    assert list(file.stages) == list(MODULES)
    assert stages_in_order(file.stages, ["report"]) == list(MODULES)
    assert {"demo", "smoke", "small", "tiny", "paper"} <= file.profiles.keys()


def test_every_packaged_profile_gives_settings_that_exist():
    file = load_stages(DEFAULT_FILE, {})
    kinds = {
        section: kind
        for name in file.stages
        for section, kind in load_stage(MODULES[name]).settings.items()
    }

    for profile in file.profiles:
        for section, given in file.choose(profile).values.items():
            build(kinds[section], {k: v.value for k, v in given.items()}, profile)


def test_the_packaged_profile_small_has_a_million_parameters(metre_moves, bent_roads):
    chosen = load_stages(DEFAULT_FILE, {}).choose("small").values["model"]
    sizes = build(ModelSettings, {k: v.value for k, v in chosen.items()}, "small")

    network = Network(sizes, metre_moves, bent_roads, TokenSettings())

    books = 2048 - metre_moves.num_motion_tokens + 1024 - bent_roads.num_map_tokens
    count = sum(p.numel() for p in network.parameters()) + books * (sizes.width + 1)
    assert 0.9e6 < count < 1.1e6


def test_the_papers_loss_weights_are_those_of_the_paper():
    chosen = load_stages(DEFAULT_FILE, {}).choose("small,paper-loss").values

    weights = {k: v.value for k, v in chosen["train"].items() if k.endswith("_weight")}
    assert weights["motion_weight"] == weights["heading_weight"] == 1
    assert (
        weights["position_weight"] == weights["keep_weight"] == weights["add_weight"] == 10
    )
    assert (weights["size_weight"], weights["agent_type_weight"]) == (0.2, 5)
    assert chosen["model"]["width"].value == 48


def test_stages_name_their_modules_deps_and_params(load):
    train = load().stages["train"]

    assert train.module == "pipeline.stages.train.stage"
    assert (train.deps, train.params) == (("ingest",), ("model", "train"))
    assert train.where == "stages.yaml:5"


def test_profile_and_words_are_laid_over_the_base_in_this_order(load):
    file = load()

    assert values(file.choose(None))["train.steps"] == 10
    assert values(file.choose("small"))["train.steps"] == 3
    chosen = values(file.choose("small", ["train.steps=7", "model.width=32"]))
    assert chosen == {
        "train.learning_rate": "5e-4",
        "train.steps": "7",
        "model.width": "32",
    }


def test_profiles_are_stacked_from_left_to_right(load):
    file = load(f"{GOOD}  long: {{train: {{steps: 50}}, model: {{width: 8}}}}\n")

    assert values(file.choose("small,long"))["train.steps"] == 50
    assert values(file.choose("long, small"))["train.steps"] == 3
    assert values(file.choose("long,small"))["model.width"] == 8
    assert file.choose("small,long").sources == ("one.tfrecord", "two.tfrecord")
    assert file.names_sources("long,small")
    assert not file.names_sources("long,plain")


def test_a_profile_may_name_its_own_sources(load):
    file = load()

    assert file.choose(None).sources == ("data/*.tfrecord",)
    assert file.choose("plain").sources == ("data/*.tfrecord",)
    assert file.choose("small").sources == ("one.tfrecord", "two.tfrecord")
    assert file.names_sources("small")
    assert not file.names_sources("plain")


def test_variables_are_filled_in_in_the_paths_of_sources(load):
    assert load(environ={"RECORDS": "/x/*"}).choose(None).sources == ("/x/*",)


def test_every_value_knows_its_line(load):
    file = load()

    assert file.choose("small").values["train"]["steps"].where == "stages.yaml:13: train"
    assert file.choose(None, ["train.steps=1"]).values["train"]["steps"].where == "-s train"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("version: 1", "version: 2", "version is 2, expected 1"),
        ("profiles:", "profile:", r"stages.yaml:10: .*'profile'; did you mean 'profiles'"),
        (
            "  plain: {}",
            "  small: {}",
            "stages.yaml:14: 'small' is given twice, .* line 11",
        ),
        ("steps: 10", "steps: 10, steps: 11", "stages.yaml:9: 'steps' is given twice"),
        ("deps: [ingest]", "deps: ingest", "stages.yaml:6: deps is 'ingest'"),
        ("deps: [ingest]", "dep: [ingest]", "stages.yaml:6: .*did you mean 'deps'"),
        ("  train: {l", "  trian: {l", "stages.yaml:9: .*'trian'; did you mean 'train'"),
        ("  train:\n", "  trainn:\n", "stages.yaml:5: stage 'trainn' needs a `module`"),
        ("train: {steps: 3}", "train: 3", "stages.yaml:13: train is 3"),
        (
            "${RECORDS:-data/*.tfrecord}",
            "${RECORDS}",
            "stages.yaml:2: .*RECORDS is not set",
        ),
        ("sources: ${", "sources: {a: ${", "stages.yaml:"),
        ("[one.tfrecord, two.tfrecord]", "[1]", "stages.yaml:12: expected a path"),
        ("version: 1", "version: 1\n\tx: 1", "stages.yaml: while scanning"),
        (GOOD, "- 1\n", "expected a mapping, got list"),
        (GOOD, "", "version is None"),
        ("steps: 10", "steps: 2020-99-99", "stages.yaml:9: "),
    ],
)
def test_what_is_wrong_is_named_with_its_line(load, old, new, message):
    with pytest.raises(ConfigError, match=message):
        load(GOOD.replace(old, new))


@pytest.mark.parametrize(
    ("profile", "words", "message"),
    [
        ("smal", [], "no profile 'smal'; did you mean 'small'"),
        ("plain,smal", [], "no profile 'smal'; did you mean 'small'"),
        ("small,", [], "no profile ''"),
        (None, ["train.steps"], "expected section.key=value"),
        (None, ["trian.steps=1"], "no section 'trian'; did you mean 'train'"),
    ],
)
def test_wrong_words_are_named(load, profile, words, message):
    with pytest.raises(ConfigError, match=message):
        load().choose(profile, words)


def test_settings_that_decide_nothing_are_left_out_of_keys():
    how = TrainSettings()
    other = TrainSettings(
        loader_workers=3, checkpoint_minutes=1.0, initial_weights="work/train"
    )

    assert key_values(other) == key_values(how)
    assert key_values(TrainSettings(steps=1)) != key_values(how)


@pytest.mark.parametrize("value", [True, "true"])
def test_yes_is_a_word_where_auto_may_stand_too(value):
    assert build(TrainSettings, {"compile": value}, "stages.yaml").compile == "true"


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml is missing; `infgen init`"):
        load_stages(tmp_path / "none.yaml", {})


def test_what_is_no_text_is_named(tmp_path):
    (tmp_path / "bad.bin").write_bytes(b"a\xff")

    with pytest.raises(ConfigError, match=r"bad\.bin is no text \(byte 0xff at 1\)"):
        load_stages(tmp_path / "bad.bin", {})
    with pytest.raises(ConfigError, match="is a folder; expected a YAML file"):
        load_stages(tmp_path, {})
    with pytest.raises(ConfigError, match=r"x.yaml cannot be read: Not a directory"):
        load_stages(tmp_path / "bad.bin" / "x.yaml", {})


def test_nothing_is_executed_or_built_by_tags(load):
    with pytest.raises(ConfigError, match="could not determine a constructor"):
        load(GOOD.replace("steps: 10", "steps: !!python/object/apply:os.getcwd []"))


def test_only_stages_that_read_sources_say_so(load):
    readers = [e.name for e in load().stages.values() if SOURCES in e.deps]

    assert readers == ["ingest"]
