"""Training on a device is that of the CPU, for every variant, and resumes.

The most kernels and waits of one step on two tiny scenes; to be lowered, never raised.
"""

import math

import pytest

MOST = {
    "paper": (2210, 1),
    "features": (2660, 1),
    "rotary": (2650, 1),
    "closed-loop": (13330, 75),
    "accumulated": (4390, 1),
    "smart": (1230, 1),
    "no-remove-token": (2180, 1),
    "no-position-token": (2190, 1),
    "no-heading-token": (2230, 1),
    "patterns": (1260, 1),
}
OF_THE_PAPER = (3980, 1)
"""Of the paper's network, with dropout, on towns: as many for one scene as for two."""


@pytest.mark.slow
@pytest.mark.parametrize("name", MOST)
def test_a_variant_learns_what_it_learns_on_a_cpu(case, shards, name):
    found = case("training", str(shards), name)

    kernels, waits = MOST[name]
    assert found["ours"] == pytest.approx(found["theirs"], rel=1e-5)
    assert found["apart"] < 1e-3
    assert found["kernels"] <= kernels, found["words"]
    assert found["waits"] <= waits, found["words"]


@pytest.mark.slow
@pytest.mark.parametrize("scenes", [1, 2])
def test_a_step_of_the_papers_network_costs_no_more_than_it_did(case, scenes):
    found = case("step", str(scenes))

    kernels, waits = OF_THE_PAPER
    assert found["kernels"] <= kernels, found["words"]
    assert found["waits"] <= waits, found["words"]


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["paper", "smart", "pretrained"])
def test_in_bf16_a_profile_learns_nearly_what_it_learns_in_float32(case, shards, profile):
    found = case("low_precision", str(shards), profile)

    assert found["bf16"] != found["float32"]
    assert found["bf16"] == pytest.approx(found["float32"], rel=0.1, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("played", ["closed-loop-population", "policy-gradient"])
def test_in_bf16_a_profile_that_plays_learns_every_loss(case, shards, played):
    # What is played differs with the precision, and with it what is learnt from.
    found = case("low_precision", str(shards), f"pretrained,{played}")

    assert found["bf16"].keys() == found["float32"].keys()
    assert all(math.isfinite(loss) for loss in found["bf16"].values())


@pytest.mark.slow
def test_biases_are_found_by_the_counts_that_a_cpu_finds(case, tmp_path):
    found = case("calibrated", str(tmp_path))

    for each in found.values():
        del each["run"]  # Names the device.
    assert found["ours"] == found["theirs"]
    assert found["ours"]["played"]["agents"] > 0


@pytest.mark.slow
def test_training_resumes_where_it_was(case, shards, tmp_path):
    found = case("resuming", str(shards), str(tmp_path))

    assert found["devices"] == ["standin:0"]
    assert found["step"] == 2
    assert found["equal"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "profile",
    [
        "small",
        "benchmark",
        "smart",
        "paper,no-remove-token,no-position-token,no-heading-token",
    ],
)
def test_a_traced_network_says_what_the_network_says(case, shards, profile):
    """Each profile has the settings of one of these, but for sizes."""
    found = case("compiled", str(shards), "paper", profile)

    assert found["ours"] == pytest.approx(found["theirs"], rel=1e-5)
