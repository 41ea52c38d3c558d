"""A progress bar on a terminal, lines elsewhere, and nothing unless a command asks."""

import io
import re
import time
import types

import pytest

from helpers.pseudo_terminal import Screen
from jetbot_mjx.terminal import progress
from jetbot_mjx.terminal.progress import show_progress, stage


def test_nothing_is_shown_in_a_program_that_imports_the_package(capfd):
    with stage("frames", 3) as advance:
        advance(1)
    assert capfd.readouterr() == ("", "")


def test_elsewhere_a_stage_that_takes_long_is_a_line_with_the_seconds_since_the_start(monkeypatch):
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_LINE", 0.2)
    stream = io.StringIO()
    with show_progress(stream):
        with stage("compiling"):
            assert stream.getvalue() == ""
            deadline = time.monotonic() + 10
            while not stream.getvalue().endswith("\n") and time.monotonic() < deadline:
                time.sleep(0.01)
            assert re.fullmatch(r" *\d+\.\d s  compiling\n", stream.getvalue())
        with stage("keys"):
            pass
        with stage("frames", 1_200) as advance:
            time.sleep(0.4)
            advance(1_200)
    lines = [line.split(" s  ") for line in stream.getvalue().splitlines()]
    assert [text for _, text in lines] == ["compiling", "frames: 1,200"]
    assert 0 < float(lines[0][0]) <= float(lines[1][0])
    with stage("more"):
        time.sleep(0.4)
    assert "more" not in stream.getvalue()


def test_a_long_stage_tells_how_far_it_is_and_how_long_it_will_take(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    stream = io.StringIO()
    with show_progress(stream), stage("frames", 100) as advance:
        for _ in range(100):
            now[0] += 0.25
            advance(1)
    said = [line.split(" s  ")[1] for line in stream.getvalue().splitlines()]
    assert said == [
        "frames: 40 of 100, about 15 s left",
        "frames: 80 of 100, about 5 s left",
    ]


def test_the_first_item_which_compiles_says_nothing_about_the_time_left(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    stream = io.StringIO()
    with show_progress(stream), stage("policies", 3) as advance:
        for seconds in (60.0, 12.0, 12.0):
            now[0] += seconds
            advance(1)
    said = [line.split(" s  ")[1] for line in stream.getvalue().splitlines()]
    assert said == ["policies: 1 of 3, 60 s so far", "policies: 2 of 3, about 12 s left"]


@pytest.mark.parametrize(("now", "left"), [(30.0, 40.0), (35.0, 35.0), (50.0, 30.0)])
def test_the_time_left_falls_while_an_item_is_under_way(now, left):
    # The second to fourth of eight took ten seconds each.
    assert progress._seconds_left([(1, 0.0), (4, 30.0)], now, 8) == left


def test_a_stage_that_advances_slowly_tells_how_long_it_will_take(monkeypatch):
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_LINE", 0.0)
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.2)
    stream = io.StringIO()
    with show_progress(stream), stage("frames", 100) as advance:
        advance(25)
        advance(25)
        deadline = time.monotonic() + 10
        while stream.getvalue().count("\n") < 3 and time.monotonic() < deadline:
            time.sleep(0.01)
    said = [line.split(" s  ")[1] for line in stream.getvalue().splitlines()]
    assert said[0] == "frames: 100"
    assert all(re.fullmatch(r"frames: 50 of 100, about \d+ s left", line) for line in said[1:])


def test_a_stage_without_a_count_is_printed_again(monkeypatch):
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_LINE", 0.1)
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.3)
    stream = io.StringIO()
    with show_progress(stream), stage("trials", 8), stage("compiling"):
        deadline = time.monotonic() + 10
        while stream.getvalue().count("\n") < 4 and time.monotonic() < deadline:
            time.sleep(0.01)
    said = [line.split(" s  ")[1] for line in stream.getvalue().splitlines()]
    # Only the inner one.
    assert sorted(said[:2]) == ["compiling", "trials: 8"]
    assert all(re.fullmatch(r"compiling: \d+ s so far", line) for line in said[2:])
    assert len(said) >= 4


def test_a_reader_that_has_gone_ends_no_command(monkeypatch):
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_LINE", 0.0)

    class Gone(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    done = []
    with show_progress(Gone()), stage("frames", 1) as advance:
        advance(1)
        time.sleep(0.1)
        done.append(True)
    assert done


@pytest.fixture
def screen(monkeypatch):
    for name in ("NO_COLOR", "TTY_INTERACTIVE", "TTY_COMPATIBLE", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    screen = Screen()
    yield screen
    screen.close()


def test_a_terminal_has_a_bar_with_an_estimate_that_goes_away_in_the_end(screen):
    with show_progress(screen.stream), stage("policies", 2), stage("frames", 40) as advance:
        for _ in range(20):
            time.sleep(0.05)
            advance(1)
        screen.until("20 of 40")
        assert "0 of 2" in screen.text
        assert re.search(r"00:0\d", screen.text)
        assert re.search(r"\d+ s\x1b", screen.text)
    screen.stream.write("after\n")
    screen.stream.flush()
    screen.until("after")
    # Both lines were erased, and the cursor is back.
    assert screen.text.endswith("\r\x1b[2K\x1b[1A\x1b[2K\x1b[?25h\rafter\r\n")


def test_a_simple_terminal_gets_lines(screen, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_LINE", 0.0)
    with show_progress(screen.stream), stage("compiling"):
        screen.until(" s  compiling\r\n")
    assert "\x1b" not in screen.text


def test_a_stage_that_fails_restores_the_terminal(screen):
    with pytest.raises(ZeroDivisionError), show_progress(screen.stream), stage("frames", 3):
        raise ZeroDivisionError
    screen.until("\x1b[?25h")
