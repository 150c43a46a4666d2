import dataclasses

import numpy as np
import pytest

from infgen.alignment import align_to_tokens
from infgen.scene import SignalState


def test_a_history_that_ends_with_a_token_stays_as_it_is(crossing):
    scene = crossing()

    assert align_to_tokens(scene) is scene


@pytest.mark.parametrize(("now", "skip"), [(49, 4), (11, 1), (4, 4)])
def test_the_first_steps_go_until_the_history_ends_with_a_token(
    crossing, build_signals, now, skip
):
    signals = build_signals([(step, 1, SignalState.GO) for step in range(91)])
    scene = dataclasses.replace(crossing(signals=signals), now=now)

    found = align_to_tokens(scene)

    assert (found.now, found.tracks.num_steps) == (now - skip, 91 - skip)
    assert found.now % 5 == 0
    np.testing.assert_array_equal(found.tracks.xyz_m, scene.tracks.xyz_m[:, skip:])
    np.testing.assert_array_equal(found.timestamps_s, scene.timestamps_s[skip:])
    assert found.signals.step.tolist() == list(range(91 - skip))
