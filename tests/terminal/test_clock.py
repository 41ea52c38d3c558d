"""The clock of the process: it counts from the start, or from the last training of a program."""

import time

from jetbot_mjx.terminal import clock, process_seconds, restart_clock


def test_a_process_knows_how_long_it_has_been_there(monkeypatch):
    monkeypatch.setattr(clock, "_origin", 0.0)
    before = process_seconds()
    time.sleep(0.05)
    assert 0.0 < before < process_seconds() < 24 * 3600


def test_a_training_begins_the_clock_again(monkeypatch):
    monkeypatch.setattr(clock, "_origin", 0.0)
    before = process_seconds()
    restart_clock()
    assert 0.0 <= process_seconds() < before
