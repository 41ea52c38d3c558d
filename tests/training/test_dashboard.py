"""The dashboard disturbs neither training nor output, and restores the terminal."""

import io
import os
import re
import subprocess
import sys
import time

import pytest
from rich.console import Console

from helpers.command_modules import train
from helpers.preemption_program import LISTENER
from helpers.pseudo_terminal import PATIENCE, Screen
from jetbot_mjx.runs.metrics import History, read_history
from jetbot_mjx.terminal import restart_clock
from jetbot_mjx.training import dashboard as dashboard_module
from jetbot_mjx.training.console import Terminal
from jetbot_mjx.training.dashboard import Dashboard, scaled, sparkline
from jetbot_mjx.training.terminal import open_terminal

REPORT = {
    "eval/success_rate": 0.625,
    "eval/episode_return": 0.81,
    "eval/time_to_goal_median": 1.25,
    "eval/time_to_goal_p95": 2.5,
    "rollout/success_rate": 0.5,
    "train/nonfinite_envs": 0.0,
    "train/nonfinite_updates": 0.0,
    "loss/total": 0.00212,
    "policy/kl": 0.0123,
    "policy/std": 0.456,
    "policy/learning_rate": 1e-3,
    "time/env_steps_per_second": 41_234.5,
}


@pytest.fixture(autouse=True)
def clock():
    """The time of this process since the test began, as if it were a command's."""
    restart_clock()


@pytest.fixture
def screen(monkeypatch):
    for name in ("NO_COLOR", "TTY_INTERACTIVE", "TTY_COMPATIBLE", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    screen = Screen()
    yield screen
    screen.close()


@pytest.fixture
def watch(screen, monkeypatch):
    """Makes the screen standard output: in the test itself, because pytest takes it back."""
    return lambda: monkeypatch.setattr(sys, "stdout", screen.stream)


@pytest.fixture
def opened(watch, tmp_path):
    """Opens the dashboard of a run of 10,000 steps on the screen."""
    dashboards = []

    def opened():
        watch()
        dashboards.append(open_terminal([tmp_path / "mine"], 10_000, [[]]))
        return dashboards[-1]

    yield opened
    for dashboard in dashboards:
        dashboard.close()


def on_screen(text):
    """What of the text is still to be seen: what came after the cursor was last at the top."""
    plain = re.split(r"(?:\x1b\[1A\x1b\[2K)+", text)[-1]
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", plain)


def test_there_is_a_dashboard_where_people_watch_and_lines_elsewhere(
    screen, watch, tmp_path, monkeypatch
):
    def chosen():
        return type(open_terminal([tmp_path], 10, [[]]))

    watch()

    assert chosen() is Dashboard
    for name, value in [("TERM", "dumb"), ("TTY_INTERACTIVE", "0")]:
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            assert chosen() is Terminal
    with monkeypatch.context() as patch:
        patch.setattr(os, "tcgetpgrp", lambda file: os.getpgrp() + 1)
        assert chosen() is Terminal
    with (
        monkeypatch.context() as patch,
        open(screen.stream.fileno(), "w", encoding="ascii", closefd=False) as ascii_only,
    ):
        patch.setattr(sys, "stdout", ascii_only)
        assert chosen() is Terminal
    # Continuous integration often forces colours.
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    assert chosen() is Terminal


def test_the_clock_moves_while_the_program_compiles(screen, opened):
    opened().begin()
    screen.until("compiling 0:00")
    screen.until("compiling 0:01")


def test_messages_are_printed_above_it_and_the_last_metrics_remain(screen, opened):
    dashboard = opened()
    dashboard.say("before")
    dashboard.begin()
    dashboard.write(2_500, [REPORT])
    dashboard.say("\x1b[1mfirst\x1b[0m [line] of /a/very/" + 30 * "long/" + "path")
    print("printed\nin two lines", file=sys.stdout)
    print("and half a", end=" ")
    print("line", flush=True)
    print("at last")
    print("unfinished", end="")
    dashboard.close()
    assert sys.stdout is screen.stream
    print("after", flush=True)
    screen.until("after")
    end = on_screen(screen.text)
    assert "before" in screen.text
    # Not broken, so that it can be copied.
    assert "[line] of /a/very/" + 30 * "long/" + "path\r\n" in screen.text
    for line in ("printed\r\n", "in two lines\r\n", "and half a line\r\n"):
        assert line in screen.text
    assert "at last\r\n" in screen.text
    assert "unfinished\r\n" in screen.text
    assert "2,500 of 10,000" in end
    assert re.search(r"╯\r\n\r\n(\r\n)?after\r\n$", end)
    # The cursor is to be seen whenever the process may be killed.
    assert screen.text.count("\x1b[?25l") == 1
    assert screen.text.index("\x1b[?25h") < screen.text.index("╭")


def test_the_headline_breaks_between_words_and_a_path_not_at_all(screen, opened, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    words = " ".join(f"word{number}" for number in range(40))
    path = "/a/very/" + 20 * "long/" + "path"
    opened().say(f"{words}\nrun folder: {path}")
    screen.until("path")
    lines = screen.text.splitlines()
    assert len(lines) > 4
    assert all(len(line) <= 60 for line in lines[:-1])
    assert " ".join(line.strip() for line in lines) == f"{words} run folder: {path}"
    assert lines[-1].strip() == path


def test_nothing_is_drawn_before_it_begins(screen, opened):
    dashboard = opened()
    dashboard.phase("saving")
    dashboard.close()
    print("nothing else", flush=True)
    screen.until("nothing else")
    assert screen.text == "nothing else\r\n"


def test_redirected_output_reaches_its_file(screen, opened, monkeypatch):
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    opened().begin()
    print("complaint", file=sys.stderr)
    assert file.getvalue() == "complaint\n"
    assert sys.stdout is not screen.stream


def test_a_terminal_that_goes_away_does_not_stop_the_training(screen, opened, monkeypatch):
    def fail(*arguments):
        raise OSError("gone")

    dashboard = opened()
    dashboard.begin()
    screen.until("╭")
    with monkeypatch.context() as patch:
        patch.setattr(screen.stream, "write", fail, raising=False)
        time.sleep(1.2)
        dashboard.write(1, [REPORT])
        dashboard.say("lost")
    dashboard.close()
    assert sys.stdout is screen.stream


def test_a_terminal_that_nobody_reads_does_not_block_the_training(tmp_path, monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    master, slave = os.openpty()
    with os.fdopen(slave, "w", encoding="utf-8", newline="") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        dashboard = open_terminal([tmp_path / "mine"], 10_000, [[]])
        assert type(dashboard) is Dashboard
        dashboard.begin()
        # More than a pseudo-terminal stores: whoever writes now waits until it is read.
        dashboard.say("filler " * 100_000)
        time.sleep(1.2)
        began = time.monotonic()
        for step in range(1_000):
            dashboard.write(step, [REPORT])
            dashboard.update(step, {}, 1.0)
            dashboard.phase("training")
            dashboard.say("line")
            print("printed")
        assert time.monotonic() - began < 1.0
        print("one more", flush=True)
        dashboard.close()
        assert time.monotonic() - began < 5.0
        assert sys.stdout is stream
        # The thread that draws ends when the terminal is gone.
        os.close(master)
        dashboard._thread.join(PATIENCE)
        assert not dashboard._thread.is_alive()
        monkeypatch.undo()


OF_A_THREAD = "ignore::pytest.PytestUnhandledThreadExceptionWarning"


@pytest.mark.parametrize(
    "error",
    # A terminal that has gone away is nobody's mistake; anything else is, and shows.
    [OSError, pytest.param(ZeroDivisionError, marks=pytest.mark.filterwarnings(OF_A_THREAD))],
)
def test_a_drawing_that_fails_ends_and_lines_come_instead(screen, opened, monkeypatch, error):
    def fail(*arguments):
        raise error

    dashboard = opened()
    dashboard.begin()
    screen.until("╭")
    monkeypatch.setattr(Dashboard, "render", fail)
    deadline = time.monotonic() + PATIENCE
    while sys.stdout is not screen.stream:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    dashboard.write(1, [REPORT])
    dashboard.say("still there")
    screen.until("still there")


def test_in_the_background_it_does_not_draw(screen, opened, monkeypatch):
    opened().begin()
    screen.until("╭")
    monkeypatch.setattr(dashboard_module, "in_foreground", lambda stream: False)
    time.sleep(0.6)
    length = len(screen.text)
    time.sleep(1.2)
    assert len(screen.text) == length


STOPPED_UNDER_A_DASHBOARD = """\
import sys
from pathlib import Path
from jetbot_mjx.training.terminal import open_terminal
terminal = open_terminal([Path("mine")], 100, [[]])
terminal.begin()
terminal.update(42, {}, 1.0)
print('listening', flush=True)
send(); time.sleep(1); send(); time.sleep(3600)"""


def test_a_signal_is_reported_above_it_and_a_second_restores_the_terminal(screen):
    lines = ["with preemption.Preemption(300) as asked:", *STOPPED_UNDER_A_DASHBOARD.splitlines()]
    program = LISTENER + "\n    ".join(lines)
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, stdout=screen.stream, stderr=screen.stream, timeout=PATIENCE)
    assert done.returncode == 75
    screen.until("second SIGTERM: leaving")
    time.sleep(0.1)
    assert "SIGTERM: finishing this step" in screen.text
    end = on_screen(screen.text)
    assert "42 of 100" in end
    assert end.endswith("─╯\r\n")
    assert screen.text.rindex("\x1b[?25h") > screen.text.rindex("\x1b[?25l")


def test_a_training_on_a_terminal_has_the_dashboard(screen, watch, root, tmp_path):
    watch()
    config = root / "configs" / "smoke.yaml"
    arguments = ["--config", str(config), "--run-dir", str(tmp_path / "mine")]
    settings = ["ppo.num_timesteps=8192", "checkpoint_interval=4096", "evaluation.episodes=16"]
    for setting in settings:
        arguments += ["--set", setting]
    assert train.main(arguments) == 0
    assert sys.stdout is screen.stream
    screen.until("jetbot-mjx play")
    text = screen.text
    for part in ("training jetbot_mjx:GoalTask", "run folder:", "first training step done"):
        assert part in text
    assert text.index("run folder:") < text.index("compiling 0:")
    end = on_screen(text)
    assert "100%  8,192 of 8,192" in end
    assert re.search(r"compiling \d:\d\d   training 0:\d\d   evaluating 0:\d\d   saving", end)
    logged = read_history(tmp_path / "mine" / "metrics.jsonl", 8_192)[-1].metrics
    assert f"{logged['time/env_steps_per_second']:,.0f} environment steps/s" in end
    assert end.index("╯") < end.index("best policy: ")


# What it shows.


@pytest.fixture
def now(monkeypatch):
    """The clock of the dashboard; set `now[0]`."""
    now = [0.0]
    fake = type("time", (), {"monotonic": staticmethod(lambda: now[0])})
    monkeypatch.setattr(dashboard_module, "time", fake)
    monkeypatch.setattr(dashboard_module, "process_seconds", lambda: now[0])
    return now


def dashboard_of(seeds=1, history=(), total=10_000, width=100):
    console = Console(file=io.StringIO(), width=width)
    names = [str(seed) for seed in range(seeds)]
    return Dashboard("mine", total, names, [history] * seeds, console)


def text_of(dashboard):
    """The lines of a dashboard, without colours."""
    console = dashboard._console
    console.file = io.StringIO()
    console.print(dashboard.render())
    return console.file.getvalue().splitlines()


def table(dashboard):
    """The cells of the table of seeds, without its header and the curves."""
    lines = text_of(dashboard)[2:]
    rows = lines[: next(number for number, line in enumerate(lines) if not line.strip("│ "))]
    return [re.sub("[▁▂▃▄▅▆▇█]+", "", line).strip("│ ").split() for line in rows]


def test_before_the_first_report_time_passes(now):
    empty = dashboard_of()
    empty.phase("compiling")
    now[0] = 61.0
    text = "\n".join(text_of(empty))
    assert "compiling 1:01" in text
    assert " 1:01 ─" in text
    assert "0%  0 of 10,000" in text
    assert re.search(r"update  - +│", text)
    assert table(empty) == [["-"] * 6]


def test_the_last_report_and_what_is_known_since(now):
    one = dashboard_of()
    one.write(2_500, [REPORT])
    assert table(one) == [["62.5%", "62.5%", "50.0%", "0.81", "1.25", "s", "2.50", "s"]]
    assert "25%  2,500 of 10,000" in "".join(text_of(one))
    assert "41,234 environment steps/s" in "".join(text_of(one))
    one.update(3_000, {"rollout/success_rate": 0.75}, 20_000.0)
    assert table(one)[0][:3] == ["62.5%", "62.5%", "75.0%"]
    assert "30%  3,000 of 10,000" in "".join(text_of(one))
    assert "20,000 environment steps/s" in "".join(text_of(one))
    one.write(5_000, [{**REPORT, "eval/success_rate": 0.25}])
    assert table(one)[0][:3] == ["25.0%", "62.5%", "50.0%"]


def test_the_dashboard_is_the_one_in_the_documentation(root):
    """The lines and columns of the guide's picture, and their labels, are those of the program."""
    guide = (root / "docs" / "getting-started.md").read_text(encoding="utf-8")
    picture = guide.split("```text\n╭")[1].split("```")[0]
    one = dashboard_of(width=80)
    one.write(2_500, [REPORT])
    shown = "\n".join(text_of(one))

    def words(text):
        return set(re.findall(r"[a-zA-Z][a-zA-Z0-9]+", text))

    phases = {"compiling", "training", "evaluating", "saving"}
    assert words(picture) - words(shown) - phases == {"left"}
    assert words(shown) - words(picture) == set()
    assert "loss 0.00212   KL 0.012   std 0.46   learning rate 1.0e-03" in shown
    assert re.search(r"memory +\d+\.\d\d GiB", shown)


def test_the_update_of_many_seeds_is_their_mean():
    two = dashboard_of(seeds=2)
    two.write(1, [REPORT, {**REPORT, "policy/std": 0.656}])
    assert "std 0.56" in "".join(text_of(two))
    two.update(2, {"policy/std": 0.25}, 1.0)
    assert "std 0.25" in "".join(text_of(two))


def test_the_time_left_counts_evaluating_and_saving_but_not_compiling(now):
    one = dashboard_of()
    now[0] = 100.0
    one.update(1_000, {}, 99_999.0)
    now[0] = 110.0  # 2,000 steps took 10 s, whatever was done in them
    one.write(3_000, [REPORT])
    assert ", 0:35 left" in "".join(text_of(one))
    one.write(10_000, [REPORT])
    assert "left" not in "".join(text_of(one))


def test_each_phase_has_its_time(now):
    one = dashboard_of()
    for seconds, phase in [(10, "training"), (3, "evaluating"), (2, "saving"), (70, "training")]:
        one.phase(phase)
        now[0] += seconds
    one.phase(None)
    now[0] += 100
    assert "training 1:20   evaluating 0:03   saving 0:02" in "".join(text_of(one))


def test_non_finite_states_are_counted_and_otherwise_not_mentioned():
    two = dashboard_of(seeds=2)
    two.write(1, [REPORT, REPORT])
    assert "non-finite" not in "".join(text_of(two))
    two.write(2, [{**REPORT, "train/nonfinite_envs": 2.0}, REPORT])
    two.write(3, [REPORT, {**REPORT, "train/nonfinite_updates": 1.0}])
    assert "non-finite  3 states or gradients" in "".join(text_of(two))


def test_a_few_seeds_have_a_row_each_and_many_their_range():
    rates = [seed / 10 for seed in range(10)]
    several, many = dashboard_of(seeds=3), dashboard_of(seeds=10)
    several.write(1, [{**REPORT, "eval/success_rate": rate} for rate in rates[:3]])
    assert [line[:2] for line in table(several)] == [["0", "0.0%"], ["1", "10.0%"], ["2", "20.0%"]]
    assert "seed" in text_of(several)[1]
    assert "seed" not in "".join(text_of(dashboard_of()))
    many.write(1, [{**REPORT, "eval/success_rate": rate} for rate in rates])
    many.write(2, [{**REPORT, "eval/success_rate": 0.5, "eval/time_to_goal_median": None}] * 10)
    assert [line[:3] for line in table(many)] == [
        ["mean", "50.0%", "50.0%"],
        ["lowest", "50.0%", "50.0%"],
        ["highest", "50.0%", "90.0%"],
    ]
    assert table(many)[0][-3:] == ["-", "2.50", "s"]


def test_a_resumed_training_shows_what_was_logged_before():
    history = [History(0, 1.0, {"eval/success_rate": 0.0}), History(2_500, 2.0, REPORT)]
    again = dashboard_of(history=history)
    assert table(again)[0][:3] == ["62.5%", "62.5%", "50.0%"]
    assert "▁▆" in "".join(text_of(again))
    assert "25%  2,500 of 10,000" in "".join(text_of(again))


@pytest.mark.parametrize("width", [1, 30, 40, 50, 60, 80, 140])
@pytest.mark.parametrize("seeds", [1, 3, 10])
def test_a_dashboard_fits_into_the_terminal(seeds, width):
    full = dashboard_of(seeds, total=10**10, width=width)
    for step in range(200):
        full.write(10**9 + step, [REPORT] * seeds)
    full.phase("training")
    lines = text_of(full)
    assert max(map(len, lines)) <= width
    assert len(lines) < 30 or width < 30
    if width >= 40:
        assert "…" not in "".join(lines)
        # A narrow terminal has fewer columns, and each of them whole.
        names = lines[1].strip("│ ").replace("to goal", "to_goal").split()
        assert {"success", "to_goal"} <= set(names)
        values = " ".join(table(full)[0]).replace(" s", "_s").split()
        assert len(values) == len(names)
        assert set(values) <= {"0", "mean", "62.5%", "50.0%", "0.81", "1.25_s", "2.50_s"}
    if width >= 80:
        assert {"best", "exploring", "return", "p95"} <= set(names)
        assert lines[2].count("▆") >= min(width, 100) - 70


def test_a_curve_is_the_whole_history_in_so_many_blocks():
    assert sparkline([0.0, 0.13, 0.5, 0.99, 1.0], 8) == "▁▂▅██"
    assert sparkline([0.0] * 500 + [1.0] * 500, 8) == "▁▁▁▁████"
    assert sparkline([], 8) == ""


def test_a_curve_of_returns_goes_from_the_lowest_to_the_highest():
    assert scaled([-100.0, 0.0, 100.0]) == [0.0, 0.5, 1.0]
    assert scaled([7.0, 7.0]) == [0.0, 0.0]
    assert scaled([]) == []


RETURN = {
    "eval/episode_return": 12.25,
    "eval/return_low": 11.0,
    "eval/episode_length": 15.5,
    "eval/success_rate": None,
    "rollout/episode_return": 3.5,
    "rollout/success_rate": None,
}


def test_without_successes_the_return_and_its_curve_are_shown(screen, opened):
    dashboard = opened()
    dashboard.begin()
    dashboard.write(0, [{**RETURN, "eval/episode_return": -4.0}])
    dashboard.write(2_500, [RETURN])
    dashboard.close()
    screen.until("╯")
    end = on_screen(screen.text)
    assert re.search(r"return +best +exploring +length", end)
    assert re.search(r"12\.25  ▁█ +12\.25 +3\.50 +15\.5", end)
    assert "success" not in end
    assert "to goal" not in end


def test_with_successes_they_come_first_in_an_environment_too(screen, opened):
    dashboard = opened()
    dashboard.begin()
    dashboard.write(2_500, [{**RETURN, "eval/success_rate": 0.5}])
    dashboard.close()
    screen.until("╯")
    end = on_screen(screen.text)
    assert re.search(r"success +best +exploring +return +length", end)
    assert re.search(r"50\.0%  ▅ +50\.0% +- +12\.25 +15\.5", end)
