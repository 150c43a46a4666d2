"""Training on a device is that of the CPU, for every variant, and resumes.

The most kernels and waits of one step on two tiny scenes; to be lowered, never raised.
"""

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
