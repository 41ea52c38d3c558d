"""Weights & Biases: imported only if configured, each step once, and no error ends a training."""

import importlib.machinery
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.command_modules import train
from helpers.fake_wandb import FakeWandb
from jetbot_mjx import load_config
from jetbot_mjx.config import parse_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.metrics import History
from jetbot_mjx.runs.wandb_sink import WandbSink, check_tracking


@pytest.fixture
def wandb(monkeypatch):
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


CONFIG = parse_config({"wandb": "jetbots", "preemption_notice": 20, "seed": 3})


@pytest.fixture
def track(tmp_path):
    """Opens the sink of a run in `mine`; `said` has what it said."""
    run_dir = tmp_path / "mine"
    run_dir.mkdir()

    def track(history=(), config=CONFIG, **arguments):
        return WandbSink(config, run_dir, history, track.said.append, **arguments)

    track.said = []
    track.run_dir = run_dir
    return track


def test_a_training_does_not_import_wandb_unless_configured(smoke_run):
    assert load_config(smoke_run / "config.yaml").wandb is None
    assert "wandb" not in sys.modules
    assert not (smoke_run / "wandb.json").exists()


# The folder of its earlier runs, where one stands, looks like a package.
NOT_INSTALLED = [None, importlib.machinery.ModuleSpec("wandb", None, is_package=True)]


@pytest.mark.parametrize("found", NOT_INSTALLED)
def test_without_the_package_nothing_is_written(tmp_path, monkeypatch, root, found):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: found)
    check_tracking(parse_config({}))
    arguments = ["--config", str(root / "configs" / "smoke.yaml"), "--set", "wandb=jetbots"]
    with pytest.raises(UserError) as refused:
        train.main([*arguments, "--run-dir", str(tmp_path / "mine")])
    assert str(refused.value) == (
        "wandb = 'jetbots' needs a package that is not installed: pip install 'jetbot_mjx[wandb]'"
    )
    assert list(tmp_path.iterdir()) == []


def test_a_run_gets_its_configuration_and_every_metric(wandb, track):
    sink = track()
    sink.write(8192, {"policy/entropy": 0.5, "eval/time_to_goal_median": None})
    sink.close()
    (run,) = wandb.runs
    arguments = run.arguments
    assert arguments["project"] == "jetbots"
    assert (arguments["name"], arguments["group"]) == ("mine", None)
    assert arguments["tags"] == ["GoalTask", "world", "isaac", "resumable"]
    assert arguments["config"]["seed"] == 3
    assert arguments["dir"] == track.run_dir
    assert (arguments["resume"], arguments["reinit"]) == ("allow", "create_new")
    assert arguments["settings"]["finish_timeout"] < 20 / 2
    assert run.logged == {
        8192: {
            "policy/entropy": 0.5,
            "train/entropy_loss": -0.5,
            "train/n_updates": 4.0,
            "time/iterations": 1.0,
            "time/total_timesteps": 8192.0,
        }
    }
    assert run.defined == {"eval/success_rate": {"summary": "max,last"}}
    assert run.finished
    assert track.said == ["Weights & Biases: https://example.com/run"]


def test_a_run_in_an_environment_is_known_by_its_name_and_return(wandb, track):
    track(config=parse_config({"wandb": "jetbots", "environment": "hopper:Hopper"})).close()
    (run,) = wandb.runs
    assert run.arguments["tags"] == ["Hopper", "resumable"]
    assert run.defined["eval/episode_return"] == {"summary": "max,last"}


def test_a_resumed_training_logs_to_the_same_run_and_no_step_twice(wandb, track):
    first = track()
    for step in (0, 10, 20):
        first.write(step, {"a": step})
    # Killed after step 20 was logged, and before its checkpoint was whole.
    second = track([History(0, 1.0, {"a": 0}), History(10, 2.0, {"a": 10})])
    for step in (20, 30):
        second.write(step, {"a": step})
    one, other = wandb.runs
    assert one.arguments["id"] == other.arguments["id"]
    assert [list(run.logged) for run in wandb.runs] == [[0, 10, 20], [30]]


def test_a_video_is_logged_once_with_the_metrics_of_its_step(wandb, track):
    first = track()
    for step in (0, 10):
        first.write(step, {"a": step})
        first.write_video(step, Path(f"{step}.mp4"))
    second = track([History(0, 1.0, {"a": 0})])
    second.write(10, {"a": 10})
    second.write_video(10, Path("10.mp4"))
    one, other = wandb.runs
    assert [told["eval/video"] for told in one.logged.values()] == [
        ("0.mp4", "mp4"),
        ("10.mp4", "mp4"),
    ]
    assert other.logged == {}


def test_earlier_metrics_are_logged_first(wandb, track):
    sink = track([History(0, 1.0, {"a": 0.5}), History(10, 2.0, {"a": 1.5})])
    sink.write(20, {"a": 2.5})
    assert [(step, told["a"]) for step, told in wandb.runs[0].logged.items()] == [
        (0, 0.5),
        (10, 1.5),
        (20, 2.5),
    ]


HUGE = '{"project": "jetbots", "id": "a", "env_steps": 1e999}'


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"project": "jetbots", "id": 3}', HUGE, None])
def test_another_project_or_a_damaged_file_begins_a_run_of_its_own(wandb, track, text):
    history = [History(0, 1.0, {"a": 0.5})]
    track(history).close()
    if text is not None:
        (track.run_dir / "wandb.json").write_text(text)
        track(history)
    else:
        track(history, parse_config({"wandb": "other"}))
    one, other = wandb.runs
    assert one.arguments["id"] != other.arguments["id"]
    assert list(other.logged) == [0]


def test_several_seeds_share_a_group_and_the_time_to_finish(wandb, tmp_path):
    for seed in (0, 1):
        (tmp_path / "five" / f"seed-{seed}").mkdir(parents=True)
        WandbSink(CONFIG, tmp_path / "five" / f"seed-{seed}", [], print, seeds=5)
    assert [run.arguments["group"] for run in wandb.runs] == ["five", "five"]
    assert [run.arguments["name"] for run in wandb.runs] == ["five-seed-0", "five-seed-1"]
    assert sum(run.arguments["settings"]["finish_timeout"] for run in wandb.runs) < 20 / 5


@pytest.mark.parametrize(
    ("where", "reason"),
    [("init", "no network"), ("log", "ValueError"), ("finish", "Timed out finishing run.")],
)
def test_its_failure_costs_one_line_and_not_the_training(wandb, track, where, reason):
    wandb.failing = {where}
    sink = track()
    for step in range(3):
        sink.write(step, {"a": 1.0})
    sink.close()
    sink.close()
    assert track.said[-1] == f"Weights & Biases: {reason}; the training continues without it"
    assert len([line for line in track.said if "without" in line]) == 1


def test_a_training_that_is_asked_to_tells_it_and_one_that_was_finished_catches_up(
    wandb, smoke_run, root, tmp_path, capsys
):
    run_dir = shutil.copytree(smoke_run, tmp_path / "mine")
    assert train.main(["--resume", str(run_dir), "--set", "wandb=jetbots"]) == 0
    (run,) = wandb.runs
    assert list(run.logged) == [0, 16_384, 32_768, 49_152, 65_536]
    assert run.finished
    assert "Weights & Biases: https://example.com/run" in capsys.readouterr().out
    assert load_config(run_dir / "config.yaml").wandb == "jetbots"


@pytest.mark.parametrize("name", ["a/b", "", 129 * "x", "50%"])
def test_a_name_that_it_would_refuse_is_refused(name):
    with pytest.raises(UserError, match="should have 1 to 128 characters, none of"):
        parse_config({"wandb": name})


OFFLINE = """
import sys
from pathlib import Path
from jetbot_mjx.config import parse_config
from jetbot_mjx.runs.wandb_sink import WandbSink
for step in (0, 10):
    sink = WandbSink(parse_config({"wandb": "jetbots"}), Path(sys.argv[1]), [], print)
    sink.write(step, {"eval/success_rate": 1.0 - step / 20})
    sink.write_video(step, Path(sys.argv[2]))
    sink.close()
"""


def test_the_package_itself_takes_what_it_is_told(tmp_path):
    if importlib.util.find_spec("wandb") is None:
        pytest.skip("wandb is not installed")
    film = tmp_path / "film.mp4"
    film.write_bytes(b"not looked into")
    done = subprocess.run(
        [sys.executable, "-c", OFFLINE, str(tmp_path), str(film)],
        env={**os.environ, "WANDB_MODE": "offline"},
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    assert done.returncode == 0
    first, second = done.stdout.splitlines()
    told = json.loads((tmp_path / "wandb.json").read_text())
    assert told["env_steps"] == 10
    assert len(list(tmp_path.glob("wandb/offline-*/files/media/videos/eval/*.mp4"))) == 2
    for line in (first, second):
        folder = line.removeprefix("Weights & Biases: offline; later: wandb sync ")
        assert folder.startswith(str(tmp_path / "wandb" / "offline-run-"))
        assert folder.endswith(told["id"])
