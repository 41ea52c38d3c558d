"""The overview of all commands."""

import importlib
import re
import subprocess
import sys

import pytest

import jetbot_mjx
from helpers.source_tree import COMMON, PACKAGE, ROOT
from jetbot_mjx import __main__ as overview


def test_every_command_is_listed_with_what_it_does(capsys):
    listed = {}
    assert overview.main([]) == 0
    for line in capsys.readouterr().out.splitlines():
        if found := re.fullmatch(r"    ([\w-]+) {2,}(.+)", line):
            listed[found[1]] = found[2]
    assert listed == {name: text for name, (_, text) in overview.COMMANDS.items()}
    at_root = {path.stem for path in (ROOT / PACKAGE).glob("*.py")}
    modules = [module for module, _ in overview.COMMANDS.values()]
    alone = {module for module in modules if "." not in module}
    assert alone == at_root - {"__init__", "__main__", "cli", "library", *COMMON}
    for module in modules:
        assert callable(importlib.import_module(f"jetbot_mjx.{module}").main)


def test_it_is_printed_at_once():
    command = [sys.executable, "-X", "importtime", "-m", "jetbot_mjx"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 120
    assert " train a policy into a run folder" in done.stdout
    assert " jetbot_mjx" in done.stderr
    assert " jax" not in done.stderr


@pytest.mark.parametrize(
    ("asked", "remedy"),
    [("evalute", ": did you mean evaluate?"), ("dance", ""), ("d" * 300, "")],
)
def test_an_unknown_command_is_refused_in_one_line(asked, remedy, capsys):
    with pytest.raises(SystemExit) as left:
        overview.main([asked, "--config", "x"])
    assert left.value.code == 2
    line = (
        f"jetbot-mjx: error: there is no command {asked!r}{remedy} (--help lists the arguments)\n"
    )
    assert capsys.readouterr().err == line


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (
            ["train"],
            "`jetbot-mjx configs` lists the configurations and `jetbot-mjx runs` lists the",
        ),
        (
            ["evaluate", "x"],
            "--list: `jetbot-mjx runs` lists the runs, and latest is the newest (--help",
        ),
        (["tune", "smoke"], "--list: `jetbot-mjx configs` lists the configurations (--help"),
        ([], "there is no command before '--list': did you mean configs or runs?"),
    ],
)
def test_list_names_the_command_that_lists_what_this_one_takes(words, hint):
    command = [sys.executable, "-m", "jetbot_mjx", *words, "--list"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert hint in done.stderr


@pytest.mark.parametrize("words", [["jetbot_mjx.train"], ["jetbot_mjx", "train"]])
def test_a_command_runs_with_a_dot_or_without(words):
    command = [sys.executable, "-m", *words, "--config", "nonsense.yaml"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: config nonsense.yaml does not exist: give a file, or one")


def test_the_version_is_told(capsys):
    with pytest.raises(SystemExit) as left:
        overview.main(["--version"])
    assert left.value.code == 0
    assert capsys.readouterr().out == f"jetbot_mjx {jetbot_mjx.__version__}\n"


def test_help_is_the_list(capsys):
    assert overview.main([]) == 0
    listed = capsys.readouterr().out
    with pytest.raises(SystemExit) as left:
        overview.main(["--help"])
    assert left.value.code == 0
    assert capsys.readouterr().out == listed
    assert listed.startswith("usage: jetbot-mjx ")


@pytest.mark.parametrize(
    "words", [["jetbot_mjx.sim2real"], ["jetbot_mjx", "sim2real"]], ids=["dot", "space"]
)
def test_the_usage_is_the_same_however_a_command_is_started(words):
    command = [sys.executable, "-m", *words, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("usage: jetbot-mjx sim2real [-h] ")


UNTOUCHED = """
import signal, sys
before = [*sys.meta_path], signal.getsignal(signal.SIGINT), sys.unraisablehook
import jetbot_mjx, jetbot_mjx.cli, jetbot_mjx.train, jetbot_mjx.training.session
added = [type(one).__module__ for one in sys.meta_path if one not in before[0]]
print(added, (signal.getsignal(signal.SIGINT), sys.unraisablehook) == before[1:])

def command(_):
    print([type(one).__module__ for one in sys.meta_path if one not in before[0]])
    return 0

jetbot_mjx.cli.run_command(command)
"""


def test_a_command_changes_imports_and_signals_and_the_package_does_not():
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", UNTOUCHED], capture_output=True, text=True
    )
    assert done.stderr == ""
    # MJX prints where its optional Warp is missing.
    imported, command = done.stdout.splitlines()[-2:]
    assert "jetbot_mjx" not in imported
    assert imported.endswith(" True")
    assert "jetbot_mjx.startup.lazy_imports" in command
