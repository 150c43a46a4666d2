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

SECTIONS = {
    "ingest": IngestSettings,
    "tokenize": TokenSettings,
    "train": TrainSettings,
    "reference": ReferenceSettings,
}
NUMBERS = [
    (section, field.name, field.type)
    for section, kind in SECTIONS.items()
    for field in fields(kind)
    if field.type in (int, float)
]
TYPES = {(section, name): kind for section, name, kind in NUMBERS}
ZERO_SAYS = {
    "ingest": ("limit",),
    "tokenize": ("max_gap_s", "insertion_distance_m"),
    "train": (
        *("steps", "learning_rate", "warmup_steps", "weight_decay", "ema_decay"),
        *("label_smoothing", "motion_weight", "map_weight", "first_motion_weight"),
        *(
            "max_map_tokens",
            "motion_noise_neighbours",
            "map_noise_neighbours",
            "motion_noise_share",
            "closed_loop_top_k",
        ),
        *(
            "loader_workers",
            "checkpoint_every_steps",
            "checkpoint_minutes",
            "validate_every_steps",
        ),
        *("validation_scenes", "seed"),
    ),
    "reference": ("count_radius_m",),
}


@pytest.mark.parametrize(("section", "name", "kind"), NUMBERS)
def test_no_number_may_be_negative(section, name, kind):
    with pytest.raises(ConfigError) as refused:
        SECTIONS[section](**{name: kind(-1)})

    said = str(refused.value)
    assert said.startswith(f"{section}.{name} is {kind(-1)}; expected ")
    assert "\n" not in said


@pytest.mark.parametrize(
    ("section", "name"),
    [(each, name) for each, names in ZERO_SAYS.items() for name in names],
)
def test_zero_may_be_said_where_it_has_a_meaning(section, name):
    zero = TYPES[section, name](0)

    assert getattr(SECTIONS[section](**{name: zero}), name) == 0


@pytest.mark.parametrize(
    ("section", "name", "value", "expected"),
    [
        ("ingest", "max_scenes_per_shard", 0, "1 or more"),
        ("tokenize", "heading_bin_deg", 0.0, "0.1 to 360"),
        ("tokenize", "heading_bin_deg", 720.0, "0.1 to 360"),
        ("tokenize", "grid_cell_m", 0.0, "0.1 or more"),
        ("tokenize", "max_ego_distance_m", 0.0, "1 or more"),
        ("train", "batch_scenes", 0, "1 or more"),
        ("train", "max_agents", 0, "1 or more"),
        ("train", "max_token_steps", 1, "2 or more"),
        ("train", "max_gradient_norm", 0.0, "1e-06 or more"),
        ("train", "label_smoothing", 1.1, "0 to 1"),
        ("train", "ema_decay", 1.5, "0 to 1"),
        ("train", "seed", 2**63, "0 to 9223372036854775807"),
    ],
)
def test_what_nothing_can_be_made_with_is_refused(section, name, value, expected):
    with pytest.raises(ConfigError) as refused:
        SECTIONS[section](**{name: value})

    assert str(refused.value) == f"{section}.{name} is {value}; expected {expected}"


@pytest.mark.parametrize("name", ["window_s", "stride_s"])
@pytest.mark.parametrize(("value", "near"), [(0.0, "0.5"), (0.7, "0.5"), (8.25, "8")])
def test_windows_are_whole_half_seconds(name, value, near):
    said = (
        f"reference.{name}: {value} s is not a whole number of 0.5 s tokens; try {near} s"
    )

    with pytest.raises(ConfigError) as refused:
        ReferenceSettings(**{name: value})

    assert str(refused.value) == said
    assert getattr(ReferenceSettings(**{name: 2.5}), name) == 2.5


def test_the_largest_seed_is_one():
    assert TrainSettings(seed=2**63 - 1).seed == 2**63 - 1


@pytest.mark.parametrize(
    "word",
    [
        *(
            "tokenize.heading_bin_deg=0",
            "reference.stride_s=0",
            "ingest.max_scenes_per_file=-1",
        ),
        *(
            "train.checkpoint_every_steps=-1",
            "train.validate_every_steps=-1",
            "train.learning_rate=inf",
        ),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(tmp_path, capsys, word):
    with pytest.raises(SystemExit) as left:
        main(["plan", "--root", str(tmp_path), "--records", "builtin", "-s", word])

    said = capsys.readouterr().err
    assert left.value.code == 2
    assert said.count("\n") == 1
    assert word.split("=")[0] in said


@pytest.mark.parametrize(
    ("kind", "wrong", "told"),
    [
        (ModelSettings, {"width": -3}, r"model\.width is -3; expected 1 or more"),
        (ModelSettings, {"width": 15, "heads": 2}, "15; expected a multiple of"),
        (ModelSettings, {"dropout": 1.5}, r"model\.dropout is 1.5; expected 0 to 1"),
        (RolloutSettings, {"seconds": -3.0}, r"rollout\.seconds: -3.0 s is not"),
        (RolloutSettings, {"seed": -1}, r"rollout\.seed is -1"),
        (ScoreSettings, {"resamples": -1}, r"score\.resamples is -1; expected 0 or more"),
    ],
)
def test_networks_rollouts_and_scores_are_of_sizes_that_can_be(kind, wrong, told):
    with pytest.raises(ConfigError, match=told):
        kind(**wrong)
