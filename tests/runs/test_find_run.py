"""Runs by name: which are found, how they are listed, and what a mistaken name is told."""

import json
from pathlib import Path

import pytest

from jetbot_mjx.config import ConfigError, find_config, load_config, parse_config, shipped_configs
from jetbot_mjx.errors import NotFoundError
from jetbot_mjx.runs import command
from jetbot_mjx.runs.checkpoint import find_checkpoint, load_checkpoint, load_policy
from jetbot_mjx.runs.checkpoint_store import CheckpointError
from jetbot_mjx.runs.find_run import PRETRAINED, find_run, list_runs, read_info, runs_table


def make_run(folder, *lines, **settings):
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(parse_config(settings).to_yaml())
    text = "".join(
        json.dumps({"env_steps": steps, "timestamp": when, "eval/success_rate": rate}) + "\n"
        for steps, when, rate in lines
    )
    (folder / "metrics.jsonl").write_text(text)
    return folder


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


def test_what_is_not_there_is_told_with_the_likely_name(runs):
    with pytest.raises(CheckpointError, match=r"did you mean newer\?") as caught:
        find_checkpoint("newr")
    assert isinstance(caught.value, FileNotFoundError)
    with pytest.raises(CheckpointError, match="give a run folder or a checkpoint in it"):
        find_checkpoint("something else")
    names = "there are camera_real, jetbot_camera, jetbot_egocentric, real_jetbot"
    with pytest.raises(NotFoundError, match=names):
        find_run("pretrained:x")


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
    newer, older = list_runs()
    assert (newer.name, older.name) == ("newer", "older")
    assert (newer.env_steps, newer.success_rate, newer.changed) == (600_000, 0.7, 50.0)
    assert older.task == "jetbot_mjx:GoalTask isaac world"
    lines = runs_table([newer, older]).splitlines()
    assert lines[0].split() == ["run", "task", "steps", "success", "age"]
    assert lines[1].split()[4:7] == ["600,000", "*", "70.0%"]
    assert lines[2].split()[4:6] == ["1,000,000", "90.0%"]
    assert "stopped before its last step" in lines[-1]


def test_a_damaged_run_is_left_out(runs):
    (runs / "runs/older/config.yaml").write_text("seed: [")
    assert [run.name for run in list_runs()] == ["newer"]
    assert read_info(runs / "runs/older") is None


def test_the_command_lists_runs_and_what_comes_with_the_package(runs, capsys):
    assert command.main([]) == 0
    out = capsys.readouterr().out
    assert out.index("newer") < out.index("older") < out.index("pretrained:jetbot_egocentric")
    assert command.main(["runs"]) == 0
    assert "pretrained:" not in capsys.readouterr().out


def test_the_command_refuses_what_is_no_folder(capsys):
    with pytest.raises(SystemExit) as left:
        command.main(["nowhere"])
    assert left.value.code == 2
    assert "nowhere is no folder" in capsys.readouterr().err


# Configurations.


def test_configurations_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert {"gpu", "jetbot", "jetbot_egocentric", "real_jetbot", "smoke"} <= set(shipped_configs())
    for name in ("smoke", "smoke.yaml", "configs/smoke.yaml"):
        assert load_config(name) == load_config(shipped_configs()["smoke"])
    # A file of one's own comes first.
    (tmp_path / "smoke").write_text("seed: 77")
    assert load_config("smoke").seed == 77


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("jetbot_egocentrc", "did you mean jetbot_egocentric?"),
        ("configs/smokee.yaml", "did you mean smoke?"),
        ("xyz", "give a file, or one of camera_gpu, camera_real, gpu,"),
    ],
)
def test_a_mistaken_configuration_is_told_the_likely_one(tmp_path, monkeypatch, name, told):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as caught:
        find_config(name)
    assert told in str(caught.value)
    assert isinstance(caught.value, ValueError)
