import pytest

from pipeline.engine.progress import ProgressMeter, clock_time, figures


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def unit_done(meter):
    meter.take({"event": "unit-done"})


def progress(meter, done, total, note=""):
    meter.take({"event": "progress", "done": done, "total": total, "note": note})


def test_units_are_counted_with_those_made_before(clock):
    meter = ProgressMeter("s", units=10, before=4, clock=clock)
    clock.now += 6
    unit_done(meter), unit_done(meter), unit_done(meter)

    assert meter.done == 7
    assert meter.per_s == pytest.approx(0.5)
    assert meter.remaining_s == pytest.approx(6)
    assert meter.words() == "7 of 10 units, 0.5/s, 0:06 left"


def test_the_rate_is_that_of_the_last_two_minutes(clock):
    meter = ProgressMeter("s", units=1000, before=0, clock=clock)
    for _ in range(300):  # Five minutes, a unit a second ...
        clock.now += 1
        unit_done(meter)
    for _ in range(30):  # ... and five more at a tenth of that.
        clock.now += 10
        unit_done(meter)

    assert meter.per_s == pytest.approx(0.1)
    assert meter.remaining_s == pytest.approx(6700)


def test_units_of_several_minutes_that_end_together_have_a_rate_too(clock):
    meter = ProgressMeter("s", units=100, before=0, clock=clock)
    for _ in range(3):
        clock.now += 300
        for _ in range(8):  # Eight workers.
            unit_done(meter)

    assert meter.per_s == pytest.approx(8 / 300)


def test_many_steps_are_written_in_full(clock):
    meter = ProgressMeter("s", units=1, before=0, clock=clock)
    progress(meter, 12_345, 2_000_000)

    assert meter.words() == "12345 of 2000000 steps"


def test_part_of_a_unit_counts_in_part(clock):
    meter = ProgressMeter("s", units=4, before=0, clock=clock)
    unit_done(meter)
    progress(meter, 5, 10)

    assert meter.done == 1.5


def test_a_stage_of_one_unit_is_told_in_its_steps(clock):
    meter = ProgressMeter("s", units=1, before=0, clock=clock)
    progress(meter, 100, 300, "loss 2.1")
    clock.now += 10
    progress(meter, 150, 300, "loss 2.0")

    assert meter.per_s == pytest.approx(5)  # Steps that a killed run took do not count.
    assert meter.words() == "150 of 300 steps, 5/s, 0:30 left, loss 2.0"


def test_gathering_is_told_apart_from_units(clock):
    meter = ProgressMeter("s", units=2, before=0, clock=clock)
    unit_done(meter), unit_done(meter)
    meter.take({"event": "finish-started"})
    progress(meter, 3, 4, "coverage")

    assert meter.done == meter.total == 2
    assert meter.words() == "gathering 75%, coverage"


def test_slow_work_is_told_in_seconds_each(clock):
    meter = ProgressMeter("s", units=10, before=0, clock=clock)
    clock.now += 40
    unit_done(meter)

    assert meter.words() == "1 of 10 units, 40 s each, 6:00 left"


def test_before_anything_is_done_nothing_is_promised(clock):
    meter = ProgressMeter("s", units=10, before=2, clock=clock)

    assert meter.per_s is None
    assert meter.remaining_s is None
    assert meter.words() == "2 of 10 units"


def test_the_first_of_many_steps_of_a_unit_promises_nothing(clock):
    meter = ProgressMeter("s", units=6, before=0, clock=clock)
    clock.now += 57
    progress(meter, 1, 600)

    assert meter.words() == "0.001667 of 6 units"


def test_progress_without_a_total_is_let_pass(clock):
    meter = ProgressMeter("s", units=1, before=0, clock=clock)
    progress(meter, 0, 0)

    assert meter.words() == "0 of 1 units"


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0, "0:00"), (7.4, "0:07"), (750.0, "12:30"), (3723.0, "1:02:03")],
)
def test_durations_are_written_as_clocks_do(seconds, words):
    assert clock_time(seconds) == words


def test_only_plain_figures_are_shown():
    report = {"scenes": 3, "share": 0.123456, "split": "training", "list": [1], "ok": True}

    assert figures(report) == "scenes 3, share 0.1235, split training"
    assert figures({f"n{i}": i for i in range(9)}, most=2) == "n0 0, n1 1"


def test_the_steps_of_an_only_unit_have_a_name_of_their_own():
    meter = ProgressMeter("s", units=1, before=0, what="scenes", clock=lambda: 0.0)
    meter.take({"event": "progress", "done": 3, "total": 12, "note": ""})

    assert meter.words() == "3 of 12 scenes"
