import os
import signal

import pytest

from pipeline.engine import signals
from pipeline.engine.signals import Stopped


def send(number=signal.SIGTERM):
    os.kill(os.getpid(), number)


@pytest.fixture(autouse=True)
def handling_signals():
    with signals.handling_signals():
        yield
    assert signals._STATE.uninterrupted == signals._STATE.deferred == 0


@pytest.mark.parametrize("number", signals.SIGNALS)
def test_a_signal_stops_at_once_and_is_remembered_by_number(number):
    with pytest.raises(Stopped) as stop:
        send(number)

    assert stop.value.signal == number


def test_a_write_is_finished_first():
    done = []

    def write():
        with signals.uninterrupted():
            send()
            done.append("written")
        done.append("never")

    with pytest.raises(Stopped):
        write()
    assert done == ["written"]


def test_an_inner_write_does_not_end_the_outer_one():
    done = []

    def write():
        with signals.uninterrupted():
            with signals.uninterrupted():
                send()
            done.append("outer")

    with pytest.raises(Stopped):
        write()
    assert done == ["outer"]


def test_patient_work_stops_where_it_checks():
    done = []

    def work():
        with signals.deferred():
            send()
            done.append("went on")
            signals.raise_if_stopped()
            done.append("never")

    with pytest.raises(Stopped):
        work()
    assert done == ["went on"]


def test_patient_work_that_never_checks_stops_at_its_end():
    def work():
        with signals.deferred():
            send()

    with pytest.raises(Stopped):
        work()


def test_a_second_signal_does_not_wait():
    done = []

    def work():
        with signals.deferred():
            send()
            done.append("first")
            send()
            done.append("never")

    with pytest.raises(Stopped):
        work()
    assert done == ["first"]


def test_a_write_within_patient_work_leaves_the_stop_to_the_check():
    done = []

    def work():
        with signals.deferred():
            with signals.uninterrupted():
                send()
            done.append("went on")
            signals.raise_if_stopped()

    with pytest.raises(Stopped):
        work()
    assert done == ["went on"]


def test_handlers_are_put_back():
    inner = signal.getsignal(signal.SIGTERM)
    with signals.handling_signals():
        pass

    assert signal.getsignal(signal.SIGTERM) is inner


def test_a_stop_that_was_heard_is_over_with_the_block():
    with pytest.raises(Stopped), signals.handling_signals():
        send()

    with signals.uninterrupted():
        assert not signals.pending_signal()


def test_without_a_signal_nothing_stops():
    with signals.deferred(), signals.uninterrupted():
        signals.raise_if_stopped()
