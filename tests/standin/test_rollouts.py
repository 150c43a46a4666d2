"""Rollouts on a device are those of the CPU, and hardly make the host wait.

The most kernels and waits of one token step of three rollouts; to be lowered, never raised.
"""

import pytest

MOST = {
    ("motion-only", "plain"): (720, 1),
    ("long", "plain"): (2010, 4),
    ("long", "rules"): (2140, 11),
}


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "rules"), MOST)
def test_rollouts_are_those_of_the_cpu_and_cost_no_more_than_they_did(case, mode, rules):
    found = case("rollout", mode, rules)

    kernels, waits = MOST[mode, rules]
    assert found["equal"] == [True, True, True]
    assert found["kernels"] <= kernels, found["words"]
    assert found["waits"] <= waits, found["words"]
