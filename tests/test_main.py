import importlib
import subprocess
import sys

import pytest
from test_structure import VERBS

from jetbot_mjx import __main__ as overview


def test_every_command_is_listed_with_what_it_does():
    listed = overview.run()
    assert sorted(overview.COMMANDS) == sorted(set(VERBS) - {"__main__"})
    for name, (how, what) in zip(overview.COMMANDS, listed.items(), strict=True):
        assert how.startswith(f"python -m jetbot_mjx.{name}")
        assert importlib.import_module(f"jetbot_mjx.{name}").__doc__.startswith(what)


def test_it_is_printed_at_once():
    command = [sys.executable, "-X", "importtime", "-m", "jetbot_mjx"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 1 + len(overview.COMMANDS)
    assert max(map(len, lines)) <= 120
    assert " trains a policy into a run folder" in done.stdout
    assert " jetbot_mjx" in done.stderr
    assert " jax" not in done.stderr


@pytest.mark.parametrize(
    ("asked", "remedy"),
    [
        ("train", "write python -m jetbot_mjx.train"),
        ("evalute", "write python -m jetbot_mjx.evaluate"),
        ("dance", "say python -m jetbot_mjx for a list"),
    ],
)
def test_what_has_no_dot_is_one_line(asked, remedy, capsys):
    assert overview.main([asked, "--config", "x"]) == 2
    assert capsys.readouterr().err == f"error: python -m jetbot_mjx {asked}: {remedy}\n"


def test_help_is_the_list(capsys):
    assert overview.main(["--help"]) == 0
    assert capsys.readouterr().out.startswith("Each tells of its arguments with --help:\n  python")
