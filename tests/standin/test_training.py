"""Training on a device is that of the CPU, for every variant, and resumes.

The most kernels and waits of one step on two tiny scenes; to be lowered, never raised.
"""

import pytest

MOST = {
    "paper": (6350, 90),
    "features": (7020, 92),
    "closed-loop": (21200, 504),
    "accumulated": (10900, 180),
    "smart": (3310, 60),
    "no-remove-token": (6270, 90),
    "no-position-token": (6300, 90),
    "no-heading-token": (6370, 90),
    "patterns": (3390, 64),
}


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
def test_training_resumes_where_it_was(case, shards, tmp_path):
    found = case("resuming", str(shards), str(tmp_path))

    assert found["devices"] == ["standin:0"]
    assert found["step"] == 2
    assert found["equal"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "features", "smart"])
def test_a_traced_network_says_what_the_network_says(case, shards, name):
    found = case("compiled", str(shards), name)

    assert found["ours"] == pytest.approx(found["theirs"], rel=1e-5)
