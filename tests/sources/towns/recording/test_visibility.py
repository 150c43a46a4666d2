"""What a recording car sees and what not: scenes in which one can tell."""

import numpy as np
import pytest

from infgen.scene import AgentType
from infgen.sources.towns.recording.visibility import (
    LONGEST_LOSS_STEPS,
    Actors,
    seen,
    tracks_of,
    wander,
)

STEPS = 60
CAR, TRUCK = (4.8, 2.0, 1.6), (9.0, 2.6, 3.4)
NO_WALLS = np.empty((0, 6))


def standing(*places, sizes=None, kinds=None):
    """Actors that stand at places [x, y] and look along +x; the first is the ego."""
    count = len(places)
    pose = np.zeros((count, STEPS, 3))
    pose[..., :2] = np.array(places)[:, None]
    return Actors(
        kind=np.array(kinds or [AgentType.VEHICLE] * count, np.int64),
        size_lwh_m=np.array(sizes or [CAR] * count),
        pose=pose,
        present=np.ones((count, STEPS), bool),
    )


def shares(actors, walls=NO_WALLS, seed=0):
    """Share of the steps at which each is seen."""
    return seen(actors, 0, walls, np.random.default_rng(seed)).mean(axis=1)


def test_who_is_near_is_seen_and_who_is_far_is_not():
    ego, near, far = shares(standing((0, 0), (10, 3), (100, 3)))

    assert ego == 1.0
    assert near > 0.9
    assert far == 0.0


def test_walls_hide_what_is_behind_them_but_not_what_is_beside():
    wall = np.array([[20.0, 0.0, np.pi / 2, 10.0, 2.0, 6.0]])

    _, behind, beside, before = shares(standing((0, 0), (40, 0), (40, 30), (10, 0)), wall)

    assert behind == 0.0
    assert beside > 0.8
    assert before > 0.9


def test_a_truck_hides_and_a_car_does_not():
    for size, hidden in ((TRUCK, True), (CAR, False)):
        found = shares(standing((0, 0), (12, 0), (30, 0), sizes=[CAR, size, CAR]))
        assert (found[2] == 0.0) == hidden
        assert found[1] > 0.9  # Nobody hides itself.


def test_people_on_foot_are_not_seen_as_far_as_cars():
    kinds = [AgentType.VEHICLE, AgentType.VEHICLE, AgentType.PEDESTRIAN]
    found = np.mean(
        [
            shares(standing((0, 0), (62, 0), (62, 5), kinds=kinds), seed=seed)
            for seed in range(8)
        ],
        axis=0,
    )

    assert found[1] > found[2] + 0.3


def test_the_farther_the_more_often_someone_is_lost():
    near, far = standing((0, 0), *[(10, 0)] * 200), standing((0, 0), *[(50, 0)] * 200)

    lost_near, lost_far = 1 - shares(near)[1:].mean(), 1 - shares(far)[1:].mean()

    assert 0.0 < lost_near < 0.01
    assert 0.01 < lost_far < 0.06


def test_who_is_not_there_is_not_seen():
    actors = standing((0, 0), (10, 0))
    actors.present[1, 30:] = False

    assert not seen(actors, 0, NO_WALLS, np.random.default_rng(0))[1, 30:].any()


@pytest.mark.parametrize(("gap", "tracks"), [(LONGEST_LOSS_STEPS, 1), (11, 2)])
def test_who_is_lost_for_long_gets_another_track(gap, tracks):
    shown = np.ones((2, STEPS), bool)
    shown[1, 20 : 20 + gap] = False

    actor, valid = tracks_of(shown)

    assert actor.tolist() == [0] + [1] * tracks
    np.testing.assert_array_equal(valid[1:].any(axis=0), shown[1])
    assert (valid[1:].sum(axis=0) <= 1).all()


def test_who_is_never_seen_has_no_track():
    shown = np.zeros((3, STEPS), bool)
    shown[1] = True

    assert tracks_of(shown)[0].tolist() == [1]


def test_noise_keeps_its_spread_and_forgets_itself():
    noise = wander(4000, 40, time_s=0.5, rng=np.random.default_rng(0))

    np.testing.assert_allclose(noise.std(axis=0), 1.0, atol=0.06)
    kept = (noise[:, 0] * noise[:, 5]).mean()
    assert kept == pytest.approx(np.exp(-1.0), abs=0.06)
