"""Presets as stages.yaml has them: read whole, and what is wrong is told with its line."""

import pytest

from infgen.config import CalibrateSettings, RolloutSettings
from infgen.errors import ConfigError
from infgen.views.published import ABLATIONS, PAPER
from pipeline.settings.presets import SCENES_SHOWN, CurvePoint
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from pipeline.settings.town_set import TownSet

GOOD = """\
version: 1
stages:
  train: {params: [train, model]}
  rollout: {deps: [train], params: [rollout]}
profiles:
  small: {train: {steps: 9}}
  motion: {model: {insertion_and_removal: false}}
presets:
  mini:
    profile: small
    seeds: 2
    count_error: truth
    train: {batch_scenes: 4}
    towns:
      training: {scenes: 40, seconds: 9.1}
    rollout_sets:
      long: {rollout: {mode: long, count: 2}}
      brief: {rollout: {mode: wosac}}
    arms:
      fine: {profile: motion, starts_from: plain, train: {steps: 1}, rollout_sets: [long]}
      plain:
        label: Plain
        profile: motion
        rollout_sets: {long: {rollout: {count: 3}}, brief: {}}
      whole: {published: InfGen, rollout_sets: [brief]}
      part: {published: no cell token, ablates: whole, rollout_sets: [brief]}
"""


@pytest.fixture
def load(tmp_path):
    def build(text=GOOD):
        path = tmp_path / "stages.yaml"
        path.write_text(text)
        return load_stages(path, {})

    return build


def words(overlay):
    return set(overlay.words)


def test_a_preset_is_read_whole(load):
    mini = load().preset("mini")

    assert (mini.profile, mini.seeds, mini.count_error) == (("small",), 2, "truth")
    assert mini.towns == {"training": TownSet(scenes=40, seconds=9.1)}
    assert mini.arms["plain"].label == "Plain"
    assert mini.arms["whole"].label == "InfGen"
    assert mini.arms["part"].ablates == "whole"
    assert list(mini.arms["plain"].rollout_sets) == ["long", "brief"]


def test_an_arm_comes_after_the_one_it_starts_from(load):
    assert list(load().preset("mini").arms) == ["plain", "fine", "whole", "part"]


def test_later_sections_of_a_preset_take_precedence(load):
    arms = load().preset("mini").arms

    assert words(arms["fine"].settings) == {"train.batch_scenes=4", "train.steps=1"}
    assert words(arms["fine"].rollout_sets["long"]) == {
        "train.batch_scenes=4",
        "train.steps=1",
        "rollout.mode=long",
        "rollout.count=2",
    }
    assert "rollout.count=3" in words(arms["plain"].rollout_sets["long"])


@pytest.mark.parametrize("name", ["towns-benchmark", "womd-mini"])
def test_rollouts_of_the_packaged_presets_have_no_rules_and_no_biases(name):
    file = load_stages(DEFAULT_FILE, {})
    preset = file.preset(name)

    for arm in preset.arms.values():
        for over in arm.rollout_sets.values():
            chosen = file.choose(",".join([*preset.profile, *arm.profile]), between=[over])
            rollout = chosen.build("rollout", RolloutSettings)
            assert rollout.rules_in_words == ("safe" if arm.rules_of else "none")
            assert (rollout.add_bias, rollout.remove_bias) == (0, 0)
            assert chosen.build("calibrate", CalibrateSettings).method == "none"
    named = {arm.rules_of for arm in preset.arms.values()} - {None}
    assert named == {"infgen", "smart", "catk"}


RULED = (
    GOOD
    + """\
      ruled: {rules_of: plain, rollout: {count: 5, seed: 1}}
"""
)


def test_an_arm_that_shows_what_rules_change_has_the_weights_of_another(load):
    mini = load(RULED).preset("mini")
    plain, ruled = mini.arms["plain"], mini.arms["ruled"]

    assert (ruled.rules_of, ruled.label, ruled.published) == ("plain", "Plain", None)
    assert ruled.profile == plain.profile
    assert list(ruled.rollout_sets) == list(plain.rollout_sets)
    for name, own in ruled.rollout_sets.items():
        added = {"rollout.count=5", "rollout.seed=1"}
        assert added <= words(own)
        kept = {word for word in words(plain.rollout_sets[name]) if "count" not in word}
        assert words(own) == kept | added


def test_an_arm_that_shows_what_rules_change_is_made_only_if_it_is_named(load):
    mini = load(RULED).preset("mini")

    assert "ruled" not in [arm.name for arm in mini.chosen([])]
    assert [arm.name for arm in mini.chosen(["ruled"])] == ["ruled"]


@pytest.mark.parametrize(
    ("new", "message"),
    [
        ("rules_of: plan", "stages.yaml:27: no rules_of 'plan'; did you mean 'plain'"),
        ("rules_of: ruled", "stages.yaml:27: rules_of is 'ruled'; expected an arm with"),
        ("rules_of: null", "stages.yaml:27: rules_of is None; expected an arm with"),
        ("rules_of: plain, train: {steps: 1}", "stages.yaml:27: ruled: no entry 'train'"),
    ],
)
def test_what_is_wrong_with_such_an_arm_is_named_with_its_line(load, new, message):
    with pytest.raises(ConfigError, match=message):
        load(RULED.replace("rules_of: plain", new, 1)).preset("mini")


def test_arms_are_picked_by_name_and_bring_those_that_they_start_from(load):
    mini = load().preset("mini")
    picked = mini.chosen(["fine", "whole"])

    assert [arm.name for arm in picked] == ["fine", "whole"]
    assert [arm.name for arm in mini.initial_arms(picked)] == ["plain"]
    assert len(mini.chosen([])) == 4
    with pytest.raises(ConfigError, match="no arm 'fin' in mini; did you mean 'fine'"):
        mini.chosen(["fin"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds: 2", "seed: 2", "stages.yaml:11: mini: no entry 'seed'.*'seeds'"),
        ("seeds: 2", "seeds: 0", "stages.yaml:11: seeds is 0; expected 1 or more"),
        ("seeds: 2", "seeds: true", "stages.yaml:11: seeds is True"),
        ("profile: small", "profile: smal", "stages.yaml:10: no profile 'smal'; did"),
        ("truth", "true", "stages.yaml:12: count_error is True; expected a word"),
        ("truth", "trut", "stages.yaml:12: no count_error 'trut'; did you mean"),
        ("scenes: 40, ", "", "stages.yaml:15: training: scenes missing"),
        ("scenes: 40,", "scenes: 4.5,", "stages.yaml:15: training.scenes is 4.5"),
        ("scenes: 40,", "scenes: 40, sede: 1,", "stages.yaml:15: training: no setting"),
        ("count: 2}", "count: [2]}", r"stages.yaml:17: rollout.count is \[2\]"),
        ("count: 2}", "count: null}", "stages.yaml:17: rollout.count is None"),
        ("long: {rollout", "long: {roll", "stages.yaml:17: long: no entry 'roll'"),
        ("brief: {rollout", "a b: {rollout", "stages.yaml:18: rollout set 'a b'; expected"),
        ("starts_from: plain", "start: plain", "no entry 'start'; it is now 'starts_from'"),
        (
            "starts_from: plain",
            "starts_from: plan",
            "stages.yaml:20: no starts_from 'plan'; did you mean",
        ),
        (
            "starts_from: plain",
            "starts_from: fine",
            "stages.yaml:20: arm 'fine' names itself",
        ),
        ("train: {steps: 1}", "trian: {steps: 1}", "stages.yaml:20: fine: no entry"),
        (
            "rollout_sets: [long]",
            "rollout_sets: [lang]",
            "stages.yaml:20: no rollout set 'lang'; did you mean",
        ),
        (
            "rollout_sets: [long]",
            "rollout_sets: long",
            "stages.yaml:20: rollout_sets is 'long'",
        ),
        ("label: Plain", "label: 3", "stages.yaml:22: label is 3; expected a word"),
        (
            "label: Plain",
            "starts_from: fine",
            "arms start each other: fine -> plain -> fine",
        ),
        (", brief: {}", ", brif: {}", "stages.yaml:24: rollout_sets: no entry 'brif'"),
        ("      whole:", "      who le:", "stages.yaml:25: arm 'who le'; expected"),
        ("published: InfGen", "published: Infgen", "stages.yaml:25: no published 'Infg"),
        ("ablates: whole", "ablates: hole", "stages.yaml:26: no ablates 'hole'; did"),
        ("  mini:\n", "  mi.ni:\n", "stages.yaml:9: preset 'mi.ni'; expected letters"),
        (
            "ablates: whole",
            "curve: {at: 3}",
            "stages.yaml:26: curve names no line",
        ),
        (
            "ablates: whole",
            "curve: {line: a, at: 0}",
            "stages.yaml:26: at is 0; expected 1 or more",
        ),
        (
            "ablates: whole",
            "curve: {lin: a}",
            "stages.yaml:26: curve: no entry 'lin'; did you mean 'line'",
        ),
        (GOOD[GOOD.index("    arms:") :], "", "stages.yaml:9: preset 'mini' has no arms"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(load, old, new, message):
    assert old in GOOD
    with pytest.raises(ConfigError, match=message):
        load(GOOD.replace(old, new, 1))


def test_points_of_a_learning_curve_are_read(load):
    text = GOOD.replace("count_error: truth", "count_error: truth\n    curve_axis: logs", 1)
    text = text.replace("ablates: whole", "curve: {line: few, at: 50}", 1)

    mini = load(text).preset("mini")

    assert mini.curve_axis == "logs"
    assert mini.arms["part"].curve == CurvePoint("few", 50)
    assert mini.arms["whole"].curve is None
    assert load().preset("mini").curve_axis == SCENES_SHOWN


def test_every_point_of_the_scaling_curve_reads_the_scenes_after_those_before_it():
    preset = load_stages(DEFAULT_FILE, {}).preset("scaling")

    shown, before = 0, None
    for arm in preset.arms.values():
        train = {name: one.value for name, one in arm.settings.values["train"].items()}
        assert arm.starts_from == before
        assert train.get("skip_steps", 0) == shown
        shown, before = shown + train["steps"], arm.name
        assert arm.name == f"shown-{shown // 1000}k"
    assert shown >= 60_000
    assert preset.towns["training"].variety == "broad"


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("transfer", ["real alone", "towns, then real", "real, then towns"]),
        ("transfer-pretrained", ["real alone", "the package's weights, then real"]),
    ],
)
def test_transfer_has_each_number_of_real_scenes_on_each_line(name, lines):
    preset = load_stages(DEFAULT_FILE, {}).preset(name)

    found = {}
    for arm in preset.arms.values():
        if arm.curve is not None:
            found.setdefault(arm.curve.line, []).append(arm.curve.at)
            scenes = arm.settings.values["train"].get("max_scenes")
            assert scenes is None or scenes.value == arm.curve.at
    assert found == {line: [50, 150, 543] for line in lines}


def test_a_preset_that_does_not_exist_is_refused_with_those_that_do(load):
    with pytest.raises(ConfigError, match="no preset 'mni'; did you mean 'mini'"):
        load().preset("mni")


def test_every_rollout_set_of_real_long_is_scored_against_its_own_source():
    preset = load_stages(DEFAULT_FILE, {}).preset("real-long")

    assert list(preset.arms) == ["infgen", "smart", "catk"]
    for arm in preset.arms.values():
        assert len(arm.rollout_sets) == 6
        for over in arm.rollout_sets.values():
            split = over.values["rollout"]["split"].value
            assert over.values["reference"]["split"].value == split
    assert preset.arms["catk"].starts_from == "smart"


def test_the_packaged_presets_compare_all_methods_of_the_paper_and_all_ablations():
    file = load_stages(DEFAULT_FILE, {})

    for name in ("towns-benchmark", "womd-mini"):
        preset = file.preset(name)
        arms = preset.chosen([])
        assert {a.published for a in arms} == {e.method for e in PAPER} | set(ABLATIONS)
        assert preset.seeds == 3
        methods = [arm for arm in arms if arm.ablates is None]
        for arm in methods:
            assert set(arm.rollout_sets) == {"long", "motion-only", "wosac"}
            radius = "score.presence_radius_m=75" in arm.rollout_sets["long"].words
            assert radius == (arm.published != "InfGen")
        assert preset.arms["catk"].starts_from == "smart"
    tuned = file.preset("womd-mini-fine-tuned")
    for arm, steps in (("package", 0), ("insertion-and-removal", 160)):
        words = tuned.arms[arm].rollout_sets["long"].words
        assert {"train.initial_weights=builtin", f"train.steps={steps}"} <= set(words)
    assert tuned.arms["closed-loop"].starts_from == "insertion-and-removal"
    assert tuned.arms["infgen"].starts_from == "closed-loop"
    assert file.preset("womd-mini").towns == tuned.towns == {}
    towns = file.preset("towns-benchmark").towns
    assert {split: each.seconds for split, each in towns.items()} == {
        "training": 9.1,
        "tuning": 31.1,
        "validation": 31.1,
    }
