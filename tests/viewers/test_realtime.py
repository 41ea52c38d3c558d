"""The clock of a viewer."""

import pytest

from jetbot_mjx.viewers.realtime import Clock, Rate


def test_steps_are_due_at_an_even_pace_that_does_not_drift():
    clock = Clock(1 / 60, now=100.0)
    assert clock.due(100.0) == 0
    # Looked at whenever it suits; after ten minutes not one step is missing.
    looks = [100.0 + 0.013 * index for index in range(1, 46_155)]
    assert sum(map(clock.due, looks)) == pytest.approx(60 * (looks[-1] - 100.0), abs=1)


def test_a_late_frame_is_caught_up_within_a_tenth_of_a_second():
    clock = Clock(1 / 60, now=0.0)
    assert clock.due(0.09) == 5
    assert clock.due(60.0) == 6
    # What a minute's sleep missed is lost, and the pace is even from there on.
    assert clock.due(60.016) == 0
    assert clock.due(60.017) == 1


def test_a_slow_clock_takes_one_step_at_a_time():
    clock = Clock(0.5, now=0.0)
    assert [clock.due(now) for now in (0.4, 0.6, 0.9, 1.1)] == [0, 1, 0, 1]


def test_a_clock_says_how_long_to_wait():
    clock = Clock(0.5, now=0.0)
    assert clock.wait(0.2) == pytest.approx(0.3)
    assert clock.wait(0.7) == 0


def test_a_rate_is_that_of_the_last_second():
    rate = Rate()
    for index in range(120):
        rate.count(index / 60)
    assert rate.per_second(2.0) == pytest.approx(60, abs=1)
    rate.count(2.0, events=5)
    assert rate.per_second(2.999) == 5
    assert rate.per_second(3.0) == 0
