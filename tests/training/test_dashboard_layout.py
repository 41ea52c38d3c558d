"""The board shows what is known, in whatever width there is."""

import io
import re

import pytest
from rich.console import Console

from jetbot_mjx.runs.metrics import History
from jetbot_mjx.training import dashboard_layout as board_module
from jetbot_mjx.training.console import EVALUATING, SAVING, TRAINING
from jetbot_mjx.training.dashboard_layout import DashboardLayout, memory_in_use, sparkline


def text_of(board, width=80):
    """The lines of a board, without colours."""
    console = Console(file=io.StringIO(), width=width)
    console.print(board.render("1.00 GiB"))
    return console.file.getvalue().splitlines()


def row(board, label, width=80):
    """What stands beside a label."""
    (line,) = (line for line in text_of(board, width) if re.match(rf"│ {label}\s", line))
    return line.strip("│ ").removeprefix(label).strip()


def table(board):
    """The cells of the table of successes, but for the curves."""
    lines = text_of(board, 100)
    first = next(number for number, line in enumerate(lines) if "success" in line)
    last = next(number for number, line in enumerate(lines) if not line.strip("│ "))
    return [re.sub("[▁▂▃▄▅▆▇█]+", "", line).strip("│ ").split() for line in lines[first:last]]


REPORT = {
    "eval/success_rate": 0.625,
    "eval/time_to_goal_median": 1.25,
    "eval/time_to_goal_p95": 2.5,
    "rollout/success_rate": 0.5,
    "loss/total": 0.01234,
    "policy/kl": 0.0051,
    "policy/std": 0.42,
    "policy/learning_rate": 3e-4,
    "train/nonfinite_envs": 0.0,
    "train/nonfinite_updates": 0.0,
    "time/env_steps_per_second": 41_234.5,
}


@pytest.fixture
def now(monkeypatch):
    """The clock of the board; set `now[0]`."""
    now = [0.0]
    fake = type("time", (), {"monotonic": staticmethod(lambda: now[0])})
    monkeypatch.setattr(board_module, "time", fake)
    return now


def board(seeds=1, history=(), total=10_000):
    return DashboardLayout("mine", total, [str(seed) for seed in range(seeds)], [history] * seeds)


def test_an_empty_board_shows_that_time_passes(now):
    empty = board()
    empty.phase("compiling")
    now[0] = 61.0
    assert row(empty, "time") == "compiling 1:01"
    assert "mine" in text_of(empty)[0]
    assert text_of(empty)[-2].endswith(" 1:01 ─╯")
    assert text_of(empty)[-1] == ""
    assert table(empty)[1] == ["-"] * 5


def test_a_board_shows_the_last_report_and_what_is_known_since(now):
    one = board()
    one.write(2_500, [REPORT])
    assert table(one) == [
        ["success", "best", "exploring", "to", "goal", "p95"],
        ["62.5%", "62.5%", "50.0%", "1.25", "s", "2.50", "s"],
    ]
    assert row(one, "steps").endswith("25%  2,500 of 10,000")
    assert row(one, "speed") == "41,234 environment steps/s"
    assert row(one, "update") == "loss 0.0123   KL 0.0051   std 0.42   learning rate 3.0e-04"
    one.tell(3_000, {"rollout/success_rate": 0.75, "policy/std": 0.4}, 20_000.0)
    assert table(one)[1][:3] == ["62.5%", "62.5%", "75.0%"]
    assert row(one, "steps").endswith("30%  3,000 of 10,000")
    assert row(one, "speed").startswith("20,000 environment steps/s")
    assert "KL 0.0051   std 0.40" in row(one, "update")
    one.write(5_000, [{**REPORT, "eval/success_rate": 0.25}])
    assert table(one)[1][:3] == ["25.0%", "62.5%", "50.0%"]


def test_the_time_left_counts_judging_and_saving_and_runs_down(now):
    one = board()
    one.phase("compiling")
    now[0] = 100.0
    one.phase(TRAINING)
    one.tell(1_000, {}, 99_999.0)
    now[0] = 110.0  # 2,000 steps took 10 s, whatever was done in them
    one.write(3_000, [REPORT])
    assert row(one, "speed").endswith("0:35 left")
    now[0] = 120.0
    assert row(one, "speed").endswith("0:25 left")
    one.phase(None)
    assert "left" not in row(one, "speed")


def test_each_phase_has_its_time(now):
    one = board()
    for seconds, phase in [(10, TRAINING), (3, EVALUATING), (2, SAVING), (70, TRAINING)]:
        one.phase(phase)
        now[0] += seconds
    assert row(one, "time") == "training 1:20   evaluating 0:03   saving 0:02"
    one.phase(None)
    now[0] += 100
    assert row(one, "time") == "training 1:20   evaluating 0:03   saving 0:02"


def test_what_was_not_finite_is_counted_and_otherwise_not_mentioned():
    one = board(seeds=2)
    one.write(1, [REPORT, REPORT])
    assert "finite" not in "".join(text_of(one))
    one.write(2, [{**REPORT, "train/nonfinite_envs": 2.0}, REPORT])
    one.write(3, [REPORT, {**REPORT, "train/nonfinite_updates": 1.0}])
    assert row(one, "not finite") == "3 worlds or gradients so far"


def test_a_few_seeds_have_a_row_each():
    several = board(seeds=3)
    several.write(1, [{**REPORT, "eval/success_rate": rate} for rate in (0.0, 0.5, 1.0)])
    assert [line[:3] for line in table(several)[1:]] == [
        ["0", "0.0%", "0.0%"],
        ["1", "50.0%", "50.0%"],
        ["2", "100.0%", "100.0%"],
    ]


def test_of_many_seeds_there_are_mean_and_range():
    many = board(seeds=10)
    assert len(table(many)) == 4
    many.write(1, [{**REPORT, "eval/success_rate": seed / 10} for seed in range(10)])
    one_without = {**REPORT, "eval/success_rate": 0.5, "eval/time_to_goal_median": None}
    many.write(2, [one_without] * 10)
    assert [line[:3] for line in table(many)[1:]] == [
        ["mean", "50.0%", "50.0%"],
        ["lowest", "50.0%", "50.0%"],
        ["highest", "50.0%", "90.0%"],
    ]
    assert table(many)[1][4:] == ["-", "2.50", "s"]


def test_a_board_goes_on_with_what_was_logged_before():
    history = [History(0, 1.0, {"eval/success_rate": 0.0}), History(2_500, 2.0, REPORT)]
    again = board(history=history)
    assert table(again)[1][:3] == ["62.5%", "62.5%", "50.0%"]
    assert "▁▆" in "".join(text_of(again))
    assert row(again, "steps").endswith("25%  2,500 of 10,000")
    assert row(again, "speed") == "-"


@pytest.mark.parametrize("width", [1, 30, 49, 50, 51, 60, 80, 140])
@pytest.mark.parametrize("seeds", [1, 3, 10])
def test_a_board_fits_into_the_terminal(seeds, width):
    full = board(seeds, total=10**10)
    for step in range(200):
        full.write(10**9 + step, [REPORT] * seeds)
    full.phase(TRAINING)
    lines = text_of(full, width)
    assert max(map(len, lines)) <= width
    assert len(lines) < 30 or width < 30
    if width >= 60:
        assert "…" not in "".join(lines)
        assert lines[2].count("▆") >= min(width, 100) - 57


def test_a_curve_is_the_whole_history_in_so_many_blocks():
    assert sparkline([0.0, 0.13, 0.5, 0.99, 1.0], 8) == "▁▂▅██"
    assert sparkline([0.0] * 500 + [1.0] * 500, 8) == "▁▁▁▁████"
    assert sparkline([], 8) == ""


def test_memory_is_that_of_a_device_which_counts_or_of_the_process(monkeypatch):
    stats = None
    device = type("Device", (), {"memory_stats": lambda self: stats})()
    monkeypatch.setattr(board_module.jax, "local_devices", lambda: [device])
    assert 0.05 < float(memory_in_use().removesuffix(" GiB")) < 64
    stats = {"bytes_in_use": 3 * 2**29, "bytes_limit": 2**37}
    assert memory_in_use() == "1.50 of 128.0 GiB on the device"
