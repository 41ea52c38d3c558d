"""The dashboard disturbs neither training nor prints, and leaves the terminal in order."""

import io
import os
import re
import subprocess
import sys
import threading
import time

import pytest
from rich.console import Console
from test_dashboard_layout import REPORT, board
from test_preemption import LISTENER

from jetbot_mjx import train
from jetbot_mjx.runs import metrics
from jetbot_mjx.training import dashboard as dashboard_module
from jetbot_mjx.training.console import SAVING, Lines
from jetbot_mjx.training.dashboard import Dashboard, open_terminal
from jetbot_mjx.training.dashboard_layout import DashboardLayout

PATIENCE = 60


class Screen:
    """A terminal as a pseudo-terminal: what is written to `stream` is in `text`."""

    def __init__(self):
        self._master, slave = os.openpty()
        self.stream = os.fdopen(slave, "w", encoding="utf-8", newline="")
        self._data = b""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self):
        while True:
            try:
                self._data += os.read(self._master, 4096)
            except OSError:
                return

    @property
    def text(self):
        return self._data.decode("utf-8", "replace")

    def until(self, text):
        deadline = time.monotonic() + PATIENCE
        while text not in self.text:
            assert time.monotonic() < deadline, self.text
            time.sleep(0.01)

    def close(self):
        self.stream.close()
        self._thread.join()
        os.close(self._master)


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
            assert chosen() is Lines
    with monkeypatch.context() as patch:
        patch.setattr(dashboard_module.os, "tcgetpgrp", lambda file: os.getpgrp() + 1)
        assert chosen() is Lines
    with (
        monkeypatch.context() as patch,
        open(screen.stream.fileno(), "w", encoding="ascii", closefd=False) as ascii_only,
    ):
        patch.setattr(sys, "stdout", ascii_only)
        assert chosen() is Lines
    # Continuous integration often forces colours.
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    assert chosen() is Lines


def test_the_clock_moves_while_the_program_compiles(screen, opened):
    opened().begin()
    screen.until("compiling 0:00")
    screen.until("compiling 0:01")


def test_what_is_said_stands_above_and_the_last_figures_stay(screen, opened):
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
    assert "printed\r\nin two lines\r\n" in screen.text
    assert "and half a line\r\n" in screen.text
    assert "at last\r\n" in screen.text
    assert "unfinished\r\n" in screen.text
    assert "2,500 of 10,000" in end
    assert re.search(r"╯\r\n\r\n(\r\n)?after\r\n$", end)
    # The cursor is to be seen whenever the process may be killed.
    assert screen.text.count("\x1b[?25l") == 1
    assert screen.text.index("\x1b[?25h") < screen.text.index("╭")


def test_nothing_is_drawn_before_it_begins(screen, opened):
    dashboard = opened()
    dashboard.phase(SAVING)
    dashboard.close()
    print("nothing else", flush=True)
    screen.until("nothing else")
    assert screen.text == "nothing else\r\n"


def test_what_goes_to_a_file_goes_there_still(screen, opened, monkeypatch):
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    opened().begin()
    print("complaint", file=sys.stderr)
    assert file.getvalue() == "complaint\n"
    assert sys.stdout is not screen.stream


def test_a_terminal_that_no_longer_reads_keeps_nobody(tmp_path, monkeypatch):
    full = threading.Event()

    class Stuck(io.StringIO):
        encoding = "utf-8"

        def isatty(self):
            return True

        def write(self, text):
            full.wait()
            return len(text)

    console = Console(file=Stuck(), force_terminal=True)
    dashboard = Dashboard(board(), console)
    monkeypatch.setattr(sys, "stdout", console.file)
    began = time.monotonic()
    dashboard.begin()
    for step in range(1_000):
        dashboard.write(step, [REPORT])
        dashboard.say("line")
    assert time.monotonic() - began < 0.5
    print("one more", flush=True)
    dashboard.close()
    assert time.monotonic() - began < 4
    full.set()


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
    monkeypatch.setattr(DashboardLayout, "render", fail)
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
    monkeypatch.setattr(dashboard_module, "_in_foreground", lambda stream: False)
    time.sleep(0.6)
    length = len(screen.text)
    time.sleep(1.2)
    assert len(screen.text) == length


STOPPED_UNDER_A_DASHBOARD = """\
import sys
from pathlib import Path
from jetbot_mjx.training.dashboard import open_terminal
terminal = open_terminal([Path("mine")], 100, [[]])
terminal.begin()
terminal.tell(42, {}, 1.0)
print('listening', flush=True)
send(); time.sleep(1); send(); time.sleep(3600)"""


def test_a_signal_is_answered_above_it_and_a_second_leaves_the_terminal_in_order(screen):
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
    screen.until("tensorboard --logdir")
    text = screen.text
    for part in ("training jetbot_mjx:GoalTask", "run folder: ", "first training step done"):
        assert part in text
    assert text.index("run folder: ") < text.index("compiling 0:00")
    end = on_screen(text)
    assert "100%  8,192 of 8,192" in end
    assert re.search(r"compiling \d:\d\d   training 0:\d\d   evaluating 0:\d\d   saving", end)
    logged = metrics.read_history(tmp_path / "mine" / "metrics.jsonl", 8_192)[-1].metrics
    assert f"{logged['time/env_steps_per_second']:,.0f} environment steps/s" in end
    assert end.index("╯") < end.index("best policy: ")
