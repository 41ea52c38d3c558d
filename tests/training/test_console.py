"""Plain lines of progress: steps, success, rate and time left."""

import io
import types

import pytest

from jetbot_mjx.training import console
from jetbot_mjx.training.console import Terminal


@pytest.fixture
def lines(monkeypatch):
    """The lines that the progress of a training of 10,000 steps prints for some reports."""

    def lines(*reports):
        stream = io.StringIO()
        sink = Terminal(10_000, stream)
        for env_steps, metrics in reports:
            monkeypatch.setattr(
                console, "process_seconds", lambda wall=metrics["time/wall_seconds"]: wall
            )
            sink.write(env_steps, [metrics])
        assert stream.getvalue().endswith("\n")
        return stream.getvalue().splitlines()

    return lines


def clocks(wall, compiled):
    return {"time/wall_seconds": wall, "time/compile_seconds": compiled}


def test_a_line_of_progress_says_how_far_how_good_and_how_fast(lines):
    metrics = {
        "eval/success_rate": 0.875,
        "eval/time_to_goal_median": 1.25,
        "time/env_steps_per_second": 123_456.7,
        **clocks(wall=61.5, compiled=12.3),
    }
    (line,) = lines((4_096, metrics))
    for part in ("4,096 steps", "success  87.5%", "to goal 1.25 s", "123,457 steps/s", "61.5 s"):
        assert part in line
    assert "(compiling 12.3 s)" in line


def test_a_line_leaves_out_what_there_is_not_yet(lines):
    metrics = {"eval/success_rate": 0.0, "eval/time_to_goal_median": None, **clocks(1.0, 0.1)}
    (line,) = lines((0, metrics))
    assert "success   0.0%" in line
    for part in ("to goal", "steps/s", "ETA", "compiling", "None"):
        assert part not in line


def test_the_time_left_follows_the_pace_of_this_interval(lines):
    # 8,000 steps are left at 100 steps/s, then 6,000 at 400.
    first, second = lines(
        (2_000, {"time/env_steps_per_second": 100.0, **clocks(20.0, 0.0)}),
        (4_000, {"time/env_steps_per_second": 400.0, **clocks(25.0, 0.0)}),
    )
    assert "ETA    80 s" in first
    assert "ETA    15 s" in second


def test_no_time_is_left_at_the_end_and_beyond(lines):
    # Training steps are whole: the last may go beyond what was asked for.
    (line,) = lines((10_240, {"time/env_steps_per_second": 100.0, **clocks(5.0, 0.0)}))
    assert "ETA     0 s" in line


def test_a_line_between_two_reports_is_printed_where_the_last_one_is_old(monkeypatch):
    now = 0.0
    monkeypatch.setattr(console, "time", types.SimpleNamespace(monotonic=lambda: now))
    stream = io.StringIO()
    sink = Terminal(10_000, stream)
    for now in (0.0, 9.0, 11.0, 12.0, 20.0, 21.5):
        sink.update(int(now), {"rollout/success_rate": 0.5}, 100.0)
    shown = stream.getvalue().splitlines()
    assert [int(line.split()[0]) for line in shown] == [0, 11, 21]
    assert all("exploring  50.0%" in line and "100 steps/s" in line for line in shown)
    assert "ETA   100 s" in shown[0]


def test_progress_goes_to_standard_output(capsys):
    Terminal(10).write(5, [{}])
    assert "5 steps" in capsys.readouterr().out


def test_of_several_seeds_a_line_says_the_mean():
    stream = io.StringIO()
    Terminal(10_000, stream).write(5, [{"eval/success_rate": 0.25}, {"eval/success_rate": 0.5}])
    assert "success  37.5%" in stream.getvalue()


def test_that_it_compiles_is_said_at_once_and_phases_are_not():
    stream = io.StringIO()
    lines = Terminal(10_000, stream)
    lines.begin()
    lines.phase("evaluating")
    lines.close()
    assert stream.getvalue() == "compiling ...\n"
