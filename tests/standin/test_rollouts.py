"""Rollouts on a device are those of the CPU, and hardly make the host wait.

The most kernels and waits of one token step of three rollouts; to be lowered, never raised.
(Density and standing features, which the package's weights have since 2026-11-24, launch 76
of them; without these there were 645, 3,008 and 3,150. Offset tokens, which they have since
2026-11-25, launch 78; without these there were 3,202 and 3,344. Removal features,
which they have since 2026-11-27, launch 44; without these there were 721, 3,280 and 3,422.
With two passes of insertion, as measured until 2026-11-28, there were 3,324 and 3,466.
Gaps to other agents, which they have since that day, launch 189; without these there were
2,374 and 2,472. Clearance of motion tokens and the ways of moving agents, which they have
since then too, launch 287 and 87; without these there were 765, 2,563 and 2,661. Logits by
the last move and by road edges where agents are inserted, which they have since 2026-11-30,
launch 98, and offset bins by road edges and headings by lanes 247 in a pass of insertion;
without these there were 1,052, 2,937 and 2,981. What the ego does, which they have since
that day, launches 10, and 5 in a pass of insertion; without it there were 1,150, 3,282 and
3,326. With rules they also draw motion tokens once more in this scene, which launches 54.)
A pass of insertion launches all its kernels, also for rollouts that are done: it could be
captured as a graph, and so is one launch and one wait.
"""

import pytest

MOST = {
    ("motion-only", "mask"): (1160, 1),
    ("long", "mask"): (3297, 2),
    ("long", "rules"): (3395, 7),
}


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "rules"), MOST)
def test_rollouts_are_those_of_the_cpu_and_cost_no_more_than_they_did(case, mode, rules):
    # No agent is inserted, so there is one pass of insertion, whatever the weights.
    found = case("rollout", mode, rules, "3", "-30")

    kernels, waits = MOST[mode, rules]
    assert found["equal"] == [True, True, True]
    assert found["kernels"] <= kernels, found["words"]
    assert found["waits"] <= waits, found["words"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "options", "steps"),
    [
        ("long", "pretrained", "7"),  # In the eighth a sample is at its very boundary.
        ("long", "crowded", "8"),
        ("long", "none", "4"),
        ("motion-only", "rules", "4"),
        ("wosac", "mask", "4"),
    ],
)
def test_longer_rollouts_of_all_options_are_those_of_the_cpu(case, mode, options, steps):
    found = case("rollout", mode, options, steps)

    assert found["equal"] == [True] * int(steps)


@pytest.mark.slow
def test_a_pass_of_insertion_never_waits_and_has_fixed_shapes(case):
    passes = case("insertion", "18")["passes"]

    assert len(passes) > 3
    assert {size for size, *_ in passes} <= {18, 16, 8}
    assert {(waits, copies) for *_, waits, copies in passes} == {(0, 0)}
    kernels = {}
    for size, launched, *_ in passes:
        kernels.setdefault(size, set()).add(launched)
    assert all(len(each) == 1 for each in kernels.values()), passes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rules", "precision"), [("none", "auto"), ("rules", "bf16"), ("crowded", "auto")]
)
def test_captured_passes_insert_what_others_insert(case, rules, precision):
    found = case("graphs", rules, precision)

    assert found["equal"] == [True] * 3
    assert min(found["inserted"]) > 8
    assert found["graphs"] == [2] * 3  # For sixteen rollouts and for eight, once each.
