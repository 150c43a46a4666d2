"""Settings that nothing can be made with are refused before anything runs."""

from dataclasses import fields

import pytest

from cli import main
from infgen.config import (
    IngestSettings,
    ModelSettings,
    ReferenceSettings,
    RolloutSettings,
    ScoreSettings,
    TokenSettings,
    TrainSettings,
)
from infgen.errors import ConfigError
from infgen.settings import build

SECTIONS = {
    "ingest": IngestSettings,
    "tokenize": TokenSettings,
    "model": ModelSettings,
    "train": TrainSettings,
    "rollout": RolloutSettings,
    "reference": ReferenceSettings,
    "score": ScoreSettings,
}
MAY_BE_NEGATIVE = {"add_bias", "remove_bias"}
NUMBERS = [
    (section, field.name)
    for section, kind in SECTIONS.items()
    for field in fields(kind)
    if type(field.default) in (int, float) and field.name not in MAY_BE_NEGATIVE
]
ZERO_MEANS = {
    "ingest": ("max_scenes_per_file",),
    "tokenize": ("max_gap_s", "insertion_distance_m"),
    "train": (
        *("steps", "learning_rate", "warmup_steps", "weight_decay", "ema_decay"),
        *("label_smoothing", "motion_weight", "map_weight", "first_motion_weight"),
        *("max_map_tokens", "motion_noise_neighbours", "map_noise_neighbours"),
        *("motion_noise_share", "closed_loop_top_k", "loader_workers"),
        *("checkpoint_every_steps", "checkpoint_minutes", "validate_every_steps"),
        *("validation_scenes", "seed"),
    ),
    "reference": ("count_radius_m",),
}


def refusal(section, **values) -> str:
    with pytest.raises(ConfigError) as refused:
        build(SECTIONS[section], values, section)
    return str(refused.value)


@pytest.mark.parametrize(("section", "name"), NUMBERS)
def test_no_number_may_be_negative(section, name):
    said = refusal(section, **{name: -1})

    assert said.startswith(f"{section}.{name} is -1; ")
    assert "\n" not in said


@pytest.mark.parametrize(
    ("section", "name"),
    [(each, name) for each, names in ZERO_MEANS.items() for name in names],
)
def test_zero_is_allowed_where_it_has_a_meaning(section, name):
    assert getattr(build(SECTIONS[section], {name: 0}, section), name) == 0


@pytest.mark.parametrize(
    ("section", "name", "value", "expected"),
    [
        ("ingest", "max_scenes_per_shard", 0, "greater than or equal to 1"),
        ("tokenize", "heading_bin_deg", 0.0, "greater than or equal to 0.1"),
        ("tokenize", "heading_bin_deg", 720.0, "less than or equal to 360"),
        ("tokenize", "grid_cell_m", 0.0, "greater than or equal to 0.1"),
        ("tokenize", "max_ego_distance_m", 0.0, "greater than or equal to 1"),
        ("model", "width", -3, "greater than or equal to 1"),
        ("model", "dropout", 1.5, "less than or equal to 1"),
        ("train", "batch_scenes", 0, "greater than or equal to 1"),
        ("train", "max_agents", 0, "greater than or equal to 1"),
        ("train", "max_token_steps", 1, "greater than or equal to 2"),
        ("train", "max_gradient_norm", 0.0, "greater than or equal to 0.000001"),
        ("train", "label_smoothing", 1.1, "less than or equal to 1"),
        ("train", "ema_decay", 1.5, "less than or equal to 1"),
        ("train", "seed", 2**63, "less than or equal to 9223372036854775807"),
        ("score", "bootstrap_resamples", -1, "greater than or equal to 0"),
    ],
)
def test_what_nothing_can_be_made_with_is_refused(section, name, value, expected):
    said = refusal(section, **{name: value})

    assert said == f"{section}.{name} is {value}; expected {expected}"


@pytest.mark.parametrize("name", ["window_s", "stride_s"])
@pytest.mark.parametrize(("value", "near"), [(0.0, "0.5"), (0.7, "0.5"), (8.25, "8")])
def test_windows_are_whole_token_steps(name, value, near):
    why = f"{value} s is not a whole number of 0.5 s tokens; try {near} s"

    assert refusal("reference", **{name: value}) == f"reference.{name} is {value}; {why}"
    assert getattr(ReferenceSettings(**{name: 2.5}), name) == 2.5


@pytest.mark.parametrize(
    ("section", "values", "said"),
    [
        ("model", {"width": 15, "heads": 2}, "model: width is 15; expected a multiple of"),
        ("model", {"signal_ahead_m": 40}, "needs signals_each_step=true"),
        ("model", {"relations": "rotary", "relation_width": 16}, "expected 0 and False"),
        ("model", {"relations": "rotary", "width": 9, "heads": 3}, "an even number"),
        ("train", {"gradient_accumulation": 17}, "more than the 16 scenes of a batch"),
        ("train", {"closed_loop_top_k": 5, "lateral_drift_share": 0.5}, "set one of them"),
        ("train", {"policy_gradient_rollouts": 2}, "expected 0, or 3 or more"),
        ("train", {"policy_minibatches": 2}, "2; expected at most 1, policy_gradient"),
        ("tokenize", {"heading_bin_deg": 7}, "does not divide 360"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(section, values, said):
    assert said in refusal(section, **values)


def test_the_largest_seed_is_one():
    assert TrainSettings(seed=2**63 - 1).seed == 2**63 - 1


@pytest.mark.parametrize(
    "word",
    [
        *("tokenize.heading_bin_deg=0", "reference.stride_s=0"),
        *("ingest.max_scenes_per_file=-1", "train.checkpoint_every_steps=-1"),
        *("train.validate_every_steps=-1", "train.learning_rate=inf"),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(tmp_path, capsys, word):
    with pytest.raises(SystemExit) as left:
        main(["plan", "--root", str(tmp_path), "--records", "builtin", "-s", word])

    said = capsys.readouterr().err
    assert left.value.code == 2
    assert said.count("\n") == 1
    assert word.split("=")[0] in said


def test_a_step_has_several_updates_only_with_rollouts():
    assert TrainSettings(policy_epochs=2).updates == 1
    assert TrainSettings(policy_gradient_rollouts=4, policy_epochs=2).updates == 2
