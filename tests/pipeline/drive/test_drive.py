"""Drives in traffic of the package's network: what a driver does, and what others do."""

from concurrent.futures import Future

import numpy as np
import pytest

from infgen.clock import CLOCK
from infgen.rollout.population import EGO_ROW
from infgen.rollout.recording import collect
from pipeline.drive import drive as drive_module
from pipeline.drive.car import RELEASED, TICKS_PER_STEP, TICKS_PER_TOKEN, Controls
from pipeline.drive.drive import LEAD_TICKS
from tests.pipeline.drive.conftest import at_once

GAS, BRAKE = Controls(throttle=1.0), Controls(brake=1.0)


def tick(drive, ticks, controls=RELEASED):
    moments = [drive.tick(controls) for _ in range(ticks)]
    assert None not in moments
    return moments


def others(drive):
    """Paths of all but the ego in the token steps so far."""
    paths = [frame.path[0] for frame in drive.frames] + [drive.shown.path]
    return [path[EGO_ROW + 1 :] for path in paths]


def same(one, other):
    return [np.array_equal(*pair) for pair in zip(one, other, strict=True)]


def test_at_first_the_network_drives_as_in_a_rollout(begin):
    drive = begin()
    moments = tick(drive, 3 * TICKS_PER_TOKEN)

    assert drive.car is None
    assert [moment.step for moment in moments[:4]] == [10.25, 10.5, 10.75, 11.0]
    for at, path in enumerate([*(f.path[0] for f in drive.frames), drive.shown.path]):
        steps = moments[at * TICKS_PER_TOKEN : (at + 1) * TICKS_PER_TOKEN]
        poses = [moment.pose for moment in steps[TICKS_PER_STEP - 1 :: TICKS_PER_STEP]]
        np.testing.assert_array_equal(poses, path[EGO_ROW])


def test_the_driver_takes_the_wheel_at_once_and_without_a_jump(begin):
    drive = begin()
    before = tick(drive, 7)[-1]
    drive.take_wheel()
    after = tick(drive, 1, GAS)[0]

    assert drive.car is not None
    away_m = np.linalg.norm(after.pose[:2] - before.pose[:2])
    assert away_m == pytest.approx(abs(before.speed_mps) * 0.025, abs=0.01)


def test_throttle_and_brakes_move_the_ego_apart(begin):
    def way_m(controls):
        drive = begin()
        drive.take_wheel()
        first = drive.world.ego_pose
        return np.linalg.norm(tick(drive, 80, controls)[-1].pose[:2] - first[:2])

    assert way_m(GAS) > way_m(BRAKE) + 5


def test_others_do_not_foresee_keys_and_react_soon_after(begin):
    def play(change):
        drive = begin()
        drive.take_wheel()
        # Alike until the third token step has been asked for ...
        tick(drive, TICKS_PER_TOKEN - LEAD_TICKS + TICKS_PER_TOKEN, GAS)
        tick(drive, 6 * TICKS_PER_TOKEN, change)
        return others(drive)

    equal = same(play(GAS), play(BRAKE))

    # ... so it is the same, whatever is done meanwhile.
    assert all(equal[:3])
    assert not all(equal[3:])


def test_the_network_sees_the_ego_where_it_is(begin):
    """But for the step from one motion token to the next: errors do not add up."""
    drive = begin()
    drive.take_wheel()
    for throttle in (1.0, 0.6, 0.0, 0.3, 1.0, 0.0, 0.6, 1.0):
        controls = Controls(throttle=throttle, steer=0.3)
        end = tick(drive, TICKS_PER_TOKEN, controls)[-1]

        seen = drive.world.population.pose[0, EGO_ROW]
        np.testing.assert_array_equal(drive.world.ego_pose, end.pose)
        assert np.linalg.norm(seen[:2] - end.pose[:2]) < 0.25
        assert abs(seen[2] - end.pose[2]) < 0.05


def test_a_drive_depends_on_controls_and_not_on_how_fast_anything_was(begin):
    def play(submit, wait):
        drive, keys = begin(submit=submit), iter([GAS] * 30 + [BRAKE] * 9 + [GAS] * 61)
        drive.take_wheel()
        for controls in keys:
            while drive.tick(controls) is None:
                wait()
        return drive

    waiting = []

    def later(work):
        waiting.append((work, Future()))
        return waiting[-1][1]

    def work_now():
        work, done = waiting.pop()
        done.set_result(work())

    swift, slow = play(at_once, None), play(later, work_now)

    assert swift.late_ticks == 0 < slow.late_ticks
    assert all(same(others(swift), others(slow)))
    np.testing.assert_array_equal(swift.car.state, slow.car.state)


def test_another_seed_is_other_traffic(begin):
    one, other = begin(seed=0), begin(seed=1)
    for drive in (one, other):
        tick(drive, 40)

    assert not all(same(others(one), others(other)))


def test_a_recording_has_the_ego_where_it_was_driven(begin):
    drive = begin()
    tick(drive, 10)
    drive.take_wheel()
    moments = tick(drive, 90, GAS)

    (rollout,) = collect([drive.world.start], drive.frames, "weights")

    now, ego = rollout.now, rollout.ego
    seen = [m for m in moments if float(m.step).is_integer() and m.step < now + 20]
    recorded = rollout.xyz_m[ego, [int(m.step) for m in seen], :2]
    np.testing.assert_array_equal(recorded, [m.pose[:2] for m in seen])
    steps_m = np.linalg.norm(np.diff(rollout.xyz_m[ego, :, :2], axis=0), axis=1)
    assert steps_m.max() < 3.5  # No jump anywhere: 35 m/s at most.


def test_the_network_goes_on_from_where_the_driver_lets_go(begin):
    drive = begin()
    drive.take_wheel()
    tick(drive, TICKS_PER_TOKEN, GAS)
    drive.hand_back()
    moments = tick(drive, 3 * TICKS_PER_TOKEN)

    assert drive.car is None
    gaps_m = np.linalg.norm(np.diff([m.pose[:2] for m in moments], axis=0), axis=1)
    assert gaps_m.max() < 33 * 0.025 * 1.5


def test_a_driver_who_takes_over_again_in_between_keeps_the_car(begin):
    drive = begin()
    drive.take_wheel()
    tick(drive, TICKS_PER_TOKEN - LEAD_TICKS - 1)
    drive.hand_back()
    tick(drive, 2)  # The next token step is asked for, the network driving.
    drive.take_wheel()
    tick(drive, 2 * TICKS_PER_TOKEN, BRAKE)

    assert drive.car is not None
    assert drive.shown.driven


def test_agents_enter_and_leave_and_are_counted(begin):
    drive = begin()
    while drive.seconds < 15 and not (drive.inserted and drive.removed):
        tick(drive, TICKS_PER_TOKEN)

    inserted = sum(int((frame.inserted_number >= 0).sum()) for frame in drive.frames)
    removed = sum(int(frame.removed.sum()) for frame in drive.frames)
    assert drive.inserted == inserted > 0
    assert drive.removed == removed + drive.shown.removed.sum() > 0


def test_memory_is_bounded_however_long_one_drives(begin, monkeypatch):
    monkeypatch.setattr(drive_module, "MAX_RECORDED_S", 1.5)
    monkeypatch.setattr(drive_module, "TIMED_STEPS", 4)
    drive = begin()
    rows = drive.world.population.pose.shape
    tick(drive, 8 * TICKS_PER_TOKEN)

    assert len(drive.frames) == 3
    assert drive.recorded_s == 1.5
    assert len(drive.step_s) == 4
    assert drive.world.population.pose.shape == rows
    assert drive.seconds == pytest.approx(8 * CLOCK.token_s)


def test_ids_are_those_of_the_recording(begin):
    drive = begin()
    while not drive.inserted:
        tick(drive, TICKS_PER_TOKEN)
    tick(drive, TICKS_PER_TOKEN + 1)

    (rollout,) = collect([drive.world.start], drive.frames, "weights")

    numbers = np.arange(len(rollout.id), dtype=np.int32)
    np.testing.assert_array_equal(drive.world.ids(numbers), rollout.id)
