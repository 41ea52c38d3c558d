"""A training without the functions that macOS and Windows lack."""

import os
import subprocess
import sys

import pytest

from jetbot_mjx.runs.run_finder import find_run

SETTINGS = ["ppo.num_timesteps=8192", "checkpoint_interval=8192", "evaluation.episodes=8"]

WITHOUT = """
import ctypes, os, signal, sys, time
for name in ("fcntl", "termios", "pwd", "grp", "resource"):
    sys.modules[name] = None
from helpers.command_modules import train
from jetbot_mjx import cli
from jetbot_mjx.training import session  # its libraries keep what they found

for name in ("tcgetpgrp", "getpgrp", "sysconf", "geteuid", "sched_getaffinity"):
    delattr(os, name)
for name in ("SIGHUP", "SIGUSR1", "pthread_kill"):
    delattr(signal, name)
del time.CLOCK_BOOTTIME

def load(self, name, *arguments, **keywords):
    if name is None:
        raise TypeError("bad argument type for built-in operation")
    original(self, name, *arguments, **keywords)

# As Windows answers `ctypes.CDLL(None)`.
original, ctypes.CDLL.__init__ = ctypes.CDLL.__init__, load
cli.run_command(train.main)
"""


@pytest.mark.slow
def test_a_training_runs_where_windows_lacks_what_unix_has(tmp_path):
    arguments = [part for setting in SETTINGS for part in ("--set", setting)]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, "smoke", "--run-dir", "run", *arguments],
        cwd=tmp_path,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "this system has no locks: start no second training in this run folder" in done.stderr
    assert "best policy: " in done.stdout
    assert (tmp_path / "run" / "checkpoints" / "000000008192").is_dir()


def test_a_path_with_either_separator_is_not_looked_up_as_a_name(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    assert find_run("a", tmp_path) == tmp_path / "a"
    assert str(find_run("a/b", tmp_path)) == "a/b"
