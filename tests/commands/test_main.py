import importlib
import subprocess
import sys

import pytest
from test_structure import COMMON, PACKAGE, ROOT

import jetbot_mjx
from jetbot_mjx import __main__ as overview


def test_every_command_is_listed_with_what_it_does():
    listed = overview.run()
    at_root = {path.stem for path in (ROOT / PACKAGE).glob("*.py")}
    assert sorted(overview.COMMANDS) == sorted(at_root - {"__init__", "__main__", "cli", *COMMON})
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
    [("evalute", "did you mean evaluate?"), ("dance", "say python -m jetbot_mjx for a list")],
)
def test_what_is_no_command_is_one_line(asked, remedy, capsys):
    assert overview.main([asked, "--config", "x"]) == 2
    line = f"error: python -m jetbot_mjx {asked}: there is no such command: {remedy}\n"
    assert capsys.readouterr().err == line


@pytest.mark.parametrize("words", [["jetbot_mjx.train"], ["jetbot_mjx", "train"]])
def test_a_command_runs_with_a_dot_or_without(words):
    command = [sys.executable, "-m", *words, "--config", "nonsense.yaml"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        done.stderr == "error: config nonsense.yaml does not exist: give the path of a YAML file\n"
    )


def test_the_version_is_told(capsys):
    assert overview.main(["--version"]) == 0
    assert capsys.readouterr().out == f"jetbot_mjx {jetbot_mjx.__version__}\n"


def test_help_is_the_list(capsys):
    assert overview.main(["--help"]) == 0
    assert capsys.readouterr().out.startswith("Each tells of its arguments with --help:\n  python")
