"""Runs by name, lists of runs, and the errors for unknown names."""

import errno
import json
import os
import re
from pathlib import Path

import pytest

from helpers.run_folders import make_run
from jetbot_mjx import list_runs as list_runs_command
from jetbot_mjx.errors import NotFoundError, UnreadableError
from jetbot_mjx.runs import run_dir
from jetbot_mjx.runs.checkpoint import find_checkpoint, load_checkpoint, load_policy
from jetbot_mjx.runs.checkpoint_store import CheckpointError
from jetbot_mjx.runs.run_dir import DamagedRunError
from jetbot_mjx.runs.run_finder import (
    PRETRAINED,
    find_run,
    read_info,
    runs_table,
    scan_runs,
)


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs/older", (0, 10.0, 0.1), (1_000_000, 20.0, 0.9))
    make_run(tmp_path / "runs/newer", (0, 30.0, 0.2), (500_000, 40.0, 0.7), (600_000, 50.0, 0.5))
    (tmp_path / "runs/no run").mkdir()
    return tmp_path


def test_a_run_is_found_by_each_of_its_names(runs):
    assert str(find_run("latest")) == "runs/newer"
    assert str(find_run("older")) == "runs/older"
    assert str(find_run("runs/older")) == "runs/older"
    assert find_run(runs / "runs" / "older") == runs / "runs" / "older"
    assert find_run("pretrained:real_jetbot") == PRETRAINED / "real_jetbot"
    # A path comes before a name.
    make_run(runs / "older", (0, 1.0, 0.0))
    assert str(find_run("older")) == "older"


def test_a_missing_run_is_refused_with_the_likely_name(runs):
    with pytest.raises(CheckpointError, match=r"did you mean newer\?") as caught:
        find_checkpoint("newr")
    assert isinstance(caught.value, FileNotFoundError)
    with pytest.raises(CheckpointError, match="give a run folder, a checkpoint in it, or a name"):
        find_checkpoint("something else")
    names = (
        "there are best, best_egocentric, camera_real, jetbot_camera, jetbot_egocentric,"
        " real_jetbot"
    )
    with pytest.raises(NotFoundError, match=names):
        find_run("pretrained:x")


def test_the_newest_run_of_a_configuration_is_suggested_for_its_name(runs):
    for age, name in enumerate(["camera_2-20261123-101500", "camera-20261122-101500"]):
        make_run(runs / "runs" / name, (0, 90.0 - age, 0.1))
    make_run(runs / "runs" / "camera-20261121-101500", (0, 60.0, 0.1))
    for given, meant in (
        ("camera", "camera-20261122-101500"),
        ("cam", "camera_2-20261123-101500"),
        ("camera_2", "camera_2-20261123-101500"),
    ):
        with pytest.raises(CheckpointError, match=rf"did you mean {meant}\?"):
            find_checkpoint(given)


def test_a_folder_of_runs_says_which_there_are(runs):
    with pytest.raises(CheckpointError, match="it holds 2 runs; name one of newer, older"):
        find_checkpoint("runs")


def test_without_runs_there_is_no_latest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NotFoundError, match="there is no run in runs/: train one first"):
        find_run("latest")


def test_python_takes_names_too():
    assert load_policy("pretrained:jetbot_egocentric") is not None


def test_results_of_the_package_s_runs_go_to_the_current_folder():
    checkpoint = load_checkpoint("pretrained:jetbot_egocentric")
    assert str(checkpoint.results_dir) == "runs/pretrained/jetbot_egocentric"
    own = checkpoint._replace(run_dir=Path("runs/mine"))
    assert own.results_dir == Path("runs/mine")


def test_runs_are_listed_the_latest_first(runs):
    newer, older = scan_runs()[0]
    assert (newer.name, older.name) == ("newer", "older")
    assert (newer.env_steps, newer.success_rate, newer.changed) == (600_000, 0.7, 50.0)
    assert older.task == "jetbot_mjx:GoalTask isaac world"
    lines = runs_table([newer, older]).splitlines()
    assert lines[0].split() == ["run", "task", "steps", "success", "age"]
    assert lines[1].split()[4:7] == ["600,000", "*", "70.0%"]
    assert lines[2].split()[4:6] == ["1,000,000", "90.0%"]
    assert "stopped before its last step" in lines[-1]


@pytest.mark.parametrize(
    ("steps", "rates", "settings", "state", "mark", "footnote"),
    [
        (1_000_000, [0.5], {}, "complete", "", ""),
        (600_000, [0.5], {}, "stopped", " *", "* stopped before its last step: "),
        (600_000, [0.5], {"stop_at_success": 0.6}, "stopped", " *", "* stopped before its"),
        (600_000, [0.6], {"stop_at_success": 0.6}, "reached", " +", "+ reached stop_at_success"),
        # It was as good before, but its last evaluation did not end it.
        (600_000, [0.7, 0.5], {"stop_at_success": 0.6}, "stopped", " *", "* stopped before its"),
    ],
)
def test_a_list_says_why_a_training_ended(
    tmp_path, capsys, steps, rates, settings, state, mark, footnote
):
    lines = [(steps - len(rates) + 1 + index, 1.0, rate) for index, rate in enumerate(rates)]
    make_run(tmp_path / "run", *lines, ppo={"num_timesteps": 1_000_000}, **settings)
    assert read_info(tmp_path / "run").state == state
    assert list_runs_command.main([str(tmp_path)]) == 0
    _, line, *rest = capsys.readouterr().out.splitlines()
    assert f" {steps:,}{mark}  " in line
    assert [one.startswith(footnote) for one in rest] == [True] * bool(footnote)
    assert list_runs_command.main([str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["state"] == state


def test_a_target_of_returns_counts_from_zero_too(tmp_path):
    run = make_run(tmp_path / "run", environment="a:B", stop_at_return=-0.5)
    line = {"env_steps": 1000, "timestamp": 1.0, "eval/episode_return": 0.0}
    (run / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    assert read_info(run).state == "reached"


def test_of_several_seeds_all_have_to_reach_the_target(tmp_path):
    run = make_run(tmp_path / "two", seeds=2, stop_at_success=0.6)
    make_run(run / "seed-0", (100, 1.0, 0.7))
    make_run(run / "seed-1", (100, 1.0, 0.5))
    assert read_info(run).state == "stopped"
    make_run(run / "seed-2", (100, 1.0, 0.5))
    for seed in (1, 2):
        (run / f"seed-{seed}" / "metrics.jsonl").unlink()
        (run / f"seed-{seed}" / "config.yaml").unlink()
    assert read_info(run).state == "reached"


def test_a_run_that_is_being_trained_is_listed_as_running(runs, capsys):
    with run_dir.occupied(runs / "runs/newer"):
        assert list_runs_command.main(["runs"]) == 0
        _, newer, _, *rest = capsys.readouterr().out.splitlines()
        assert " 600,000 running  " in newer
        assert not rest
        assert [run.state for run in scan_runs()[0]] == ["running", "complete"]
    # The lock's file stays, and the lock does not.
    assert (runs / "runs/newer/.lock").is_file()
    assert [run.state for run in scan_runs()[0]] == ["stopped", "complete"]


LAUGHS = "a0: &a0 [x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12)
)


def config_cut(length):
    """A harm: the configuration ends after so many characters, or lines if that is negative."""

    def cut(path):
        text = path.read_text()
        lines = text.splitlines(keepends=True)
        path.write_text(text[:length] if length >= 0 else "".join(lines[:length]))

    return cut


HARMS = {
    "open": (lambda path: path.write_text("seed: [\n"), "line 2 is not valid YAML"),
    "empty": (config_cut(0), "config.yaml is empty"),
    "one character": (config_cut(1), "was cut off: its last line is not complete"),
    "half": (config_cut(702), "was cut off: its last line is not complete"),
    "whole lines": (config_cut(-30), "was cut off: it has no section evaluation"),
    "before the last section": (config_cut(-3), "was cut off: it has no section evaluation"),
    "aliases": (lambda path: path.write_text(LAUGHS), "aliases stand for more than 100,000"),
    "digits": (lambda path: path.write_text(f"seed: {'9' * 5000}\n"), "has too many digits"),
    "large": (lambda path: path.write_text("#" * 200_000 + "\n"), "more than 100,000 characters"),
    "binary": (lambda path: path.write_bytes(b"\xff\n"), "is not UTF-8 text"),
    "gone": (lambda path: path.unlink(), "config.yaml is missing"),
    "folder": (lambda path: (path.unlink(), path.mkdir()), "cannot be read: Is a directory"),
    "pipe": (lambda path: (path.unlink(), os.mkfifo(path)), "is not a regular file"),
    "loop": (lambda path: (path.unlink(), path.symlink_to(path.name)), "levels of symbolic links"),
    "device": (lambda path: (path.unlink(), path.symlink_to("/dev/zero")), "not a regular file"),
}


@pytest.mark.parametrize(("harm", "said"), HARMS.values(), ids=HARMS)
def test_a_damaged_run_is_listed_with_the_reason_and_stops_no_other(runs, capsys, harm, said):
    harm(runs / "runs/newer/config.yaml")
    assert [run.name for run in scan_runs()[0]] == ["older"]
    assert str(find_run("latest")) == "runs/older"
    with pytest.raises(DamagedRunError, match=re.escape(said)):
        read_info(runs / "runs/newer")
    assert list_runs_command.main(["runs"]) == 0
    _, older, damaged = capsys.readouterr().out.splitlines()
    assert older.startswith("older ")
    assert damaged.startswith("damaged: newer: config.yaml")
    assert said in damaged


@pytest.mark.parametrize("name", ["config.yaml", "metrics.jsonl"])
def test_a_run_on_a_drive_that_does_not_answer_is_not_damaged(runs, monkeypatch, capsys, name):
    opened = run_dir.open_at_once

    def open_or_not(path, flags):
        if os.fspath(path).endswith(f"newer/{name}"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return opened(path, flags)

    monkeypatch.setattr(run_dir, "open_at_once", open_or_not)
    said = f"runs/newer/{name} cannot be read now: Input/output error"
    assert list_runs_command.main(["runs"]) == 0
    _, older, unreadable = capsys.readouterr().out.splitlines()
    assert older.startswith("older ")
    assert unreadable.startswith(said)
    # What is the latest is not known.
    with pytest.raises(UnreadableError, match=said):
        find_run("latest")


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        '{"env_steps": "9", "timestamp": 99}',
        '{"env_steps": 9, "timestamp": "99"}',
        '{"env_steps": -9, "timestamp": 99}',
        '{"env_steps": 9, "timestamp": NaN}',
        '{"env_steps": 9, "timestamp": 1e300}',
        '{"env_steps": 9, "timestamp": 99, "eval/success_rate": [1]}',
        '{"env_steps": 9, "timestamp": 99, "eval/success_rate": 1' + "0" * 400 + "}",
        '{"env_steps": ' + "9" * 5000 + ', "timestamp": 99}',
        "[" * 100_000,
    ],
    ids=range(9),
)
def test_a_line_that_no_training_wrote_is_left_out(runs, line):
    with (runs / "runs/newer/metrics.jsonl").open("a") as file:
        file.write(line + "\n")
    assert (scan_runs()[0][0].env_steps, scan_runs()[0][0].changed) == (600_000, 50.0)
    assert len(runs_table(scan_runs()[0]).splitlines()) == 4


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo], ids=["folder", "pipe"])
def test_metrics_that_cannot_be_read_are_told(runs, make):
    path = runs / "runs/newer/metrics.jsonl"
    path.unlink()
    make(path)
    (healthy,), (damaged,) = scan_runs()
    assert (healthy.name, damaged.run_dir.name) == ("older", "newer")
    assert "metrics.jsonl cannot be read: " in damaged.reason


def test_without_an_intact_run_latest_says_what_is_wrong(runs):
    for name in ("older", "newer"):
        (runs / f"runs/{name}/config.yaml").write_text("")
    with pytest.raises(NotFoundError, match=r"damaged, such as newer: config\.yaml is empty"):
        find_run("latest")


def test_no_name_can_command_the_terminal(runs, capsys):
    make_run(runs / "runs" / "\x1b[31mred\r\n\u202e", (0, 1.0, 0.0))
    make_run(runs / "runs" / "\x1b]0;title\x07", (0, 1.0, 0.0))
    (runs / "runs" / "\x1b]0;title\x07" / "config.yaml").write_text("\x1b: 1")
    assert list_runs_command.main(["runs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(line.isprintable() for line in lines)
    assert lines[3].startswith(r"\x1b[31mred\r\n\u202e")
    assert lines[5].startswith(r"damaged: \x1b]0;title\x07: config.yaml was cut off")


# Configurations.


def test_a_robot_of_other_measures_takes_no_more_room(runs):
    robot = {"preset": "real", "wheel_radius": 0.04, "chassis_mass": 0.9}
    run = make_run(runs / "runs/own", (0, 60.0, 0.5), robot=robot)
    assert read_info(run).task == "jetbot_mjx:GoalTask real, changed world"


def test_a_run_in_an_environment_shows_its_name_and_return(runs):
    run = make_run(runs / "runs/own", environment="hopper:Hopper")
    lines = [
        {"env_steps": 1000 * i, "timestamp": 60.0 + i, "eval/episode_return": value}
        for i, value in enumerate((-5.0, 812.5, 700.0))
    ]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    info = read_info(run)
    assert (info.task, info.success_rate, info.episode_return) == ("hopper:Hopper", None, 812.5)
    assert re.search(r"own +hopper:Hopper +2,000 \* +return 812\.5", runs_table([info]))
    # Of a robot, which has a success rate, the return is not told.
    assert read_info(runs / "runs/newer").episode_return is None
    # Where the environment tells successes, they are.
    with (run / "metrics.jsonl").open("a") as file:
        line = {"env_steps": 3000, "timestamp": 70.0, "eval/success_rate": 0.25}
        file.write(json.dumps(line) + "\n")
    assert "25.0%" in runs_table([read_info(run)])
