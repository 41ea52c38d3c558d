"""The policies that come with the package."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.command_modules import evaluate, train
from jetbot_mjx import PRETRAINED, load_policy, play, pretrained, viewers
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys, summarize
from jetbot_mjx.runs import copy_pretrained
from jetbot_mjx.runs.checkpoint import load_checkpoint

NAMES = (
    "best",
    "best_egocentric",
    "camera_real",
    "jetbot_camera",
    "jetbot_egocentric",
    "real_jetbot",
)
THEN = {"physics.ls_iterations": 4}
"""Defaults that were others when some of these policies were trained."""

CHANGED = {
    "camera_real": THEN,
    "jetbot_camera": THEN,
    "jetbot_egocentric": {
        **THEN,
        "task.step_cost": 0.0,
        "ppo.num_timesteps": 2_621_440,
        "ppo.learning_rate": 1.0e-3,
        "ppo.discounting": 0.95,
        "ppo.network.activation": "tanh",
    },
    "real_jetbot": THEN,
}
"""What a run that comes with the package changes of its configuration."""


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return copy_pretrained(pretrained.FOLDER)


def test_there_is_a_run_for_each_of_six_configurations(runs):
    assert runs == tuple(Path("runs/pretrained") / name for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_it_was_trained_by_the_configuration_of_its_name(name, root):
    trained = load_config(PRETRAINED / name / "config.yaml")
    changed = [f"{key}={value}" for key, value in CHANGED.get(name, {}).items()]
    assert trained == load_config(root / "configs" / f"{name}.yaml", changed)
    assert load_checkpoint(PRETRAINED / name).config == trained


# One that sees and one that does not. The report of "jetbot_egocentric" below is quick.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["camera_real", "real_jetbot"])
@pytest.mark.usefixtures("optimized")
def test_it_reaches_the_first_goals_of_the_report(name):
    checkpoint = load_checkpoint(PRETRAINED / name)
    setup = checkpoint.make_setup()
    evaluator = Evaluator(setup.env, setup.networks, setup.programs)
    episodes = evaluator.run(checkpoint.params, report_keys(128))
    assert summarize(episodes, setup.env.dt).success_rate >= 0.99


@pytest.mark.parametrize(
    ("name", "episodes"),
    [
        ("jetbot_egocentric", 128),
        *(pytest.param(name, 1024, marks=pytest.mark.slow) for name in NAMES),
    ],
)
@pytest.mark.usefixtures("blank_figures", "optimized")
def test_its_report_tells_that_it_reaches_them(name, episodes, runs):
    run = runs[NAMES.index(name)]
    assert evaluate.main([str(run), "--min-success", "0.99", "--episodes", str(episodes)]) == 0
    (report,) = run.glob("evaluations/*/report.json")
    assert json.loads(report.read_text("utf-8"))["policy"]["episodes"] == episodes


def test_its_policy_turns_towards_the_goal():
    # Turns towards a goal on its left, 1 m away.
    policy = load_policy(PRETRAINED / "jetbot_egocentric")
    left, right = (jnp.array([0.0, side, 0.0, side, 1.0, 0.3, 0.0]) for side in (1.0, -1.0))
    assert float(policy(left)[1]) > 0.1
    assert float(policy(right)[1]) < -0.1


@pytest.mark.slow
def test_it_can_be_trained_further(runs):
    run = runs[NAMES.index("jetbot_egocentric")]
    (start,) = (int(path.name) for path in (run / "checkpoints").iterdir())
    interval = load_config(run / "config.yaml").checkpoint_interval
    further = f"ppo.num_timesteps={start + interval}"
    assert train.main(["--resume", str(run), "--set", further]) == 0
    assert load_checkpoint(run, "last").env_steps == start + interval


def test_nothing_is_overwritten(runs):
    kept = runs[1] / "config.yaml"
    kept.write_text("mine")
    with pytest.raises(UserError, match="runs/pretrained/best exists already: choose"):
        pretrained.main([])
    for path in sorted(runs[0].rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    runs[0].rmdir()
    with pytest.raises(UserError, match="runs/pretrained/best_egocentric exists already: choose"):
        pretrained.main([])
    assert kept.read_text() == "mine"
    assert not runs[0].exists()


def test_results_that_commands_wrote_about_a_run_stay_beside_it(tmp_path):
    page = tmp_path / "best" / "page.html"
    page.parent.mkdir()
    page.write_text("a page")
    for run in copy_pretrained(tmp_path):
        assert load_checkpoint(run).env_steps > 0
    assert page.read_text() == "a page"
    with pytest.raises(UserError, match="best exists already: choose"):
        copy_pretrained(tmp_path)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file/runs/best cannot be written: Not a dir"):
        copy_pretrained(tmp_path / "file" / "runs")


def test_it_tells_where_the_runs_are(tmp_path, capsys):
    assert pretrained.main(["--output", str(tmp_path / "here")]) == 0
    printed = capsys.readouterr().out
    for name in NAMES:
        assert f"run folder: {tmp_path / 'here' / name}\n" in printed
    assert f"jetbot-mjx play {tmp_path / 'here' / NAMES[0]}\n" in printed


def test_play_takes_it_where_no_run_is_named(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("runs/mine").mkdir(parents=True)
    given = []
    monkeypatch.setattr(
        viewers,
        "play_live",
        lambda run, **more: given.append((run, more["which"])) or (0, 0),
    )
    assert play.main([]) == 0
    assert given == [(PRETRAINED / "jetbot_egocentric", "best")]
    assert "no RUN given" in capsys.readouterr().out
    assert play.main(["runs/mine"]) == 0
    assert given[1] == (Path("runs/mine"), "best")
    assert "no RUN given" not in capsys.readouterr().out


def test_nothing_in_it_names_the_machine_it_was_made_on():
    for path in PRETRAINED.rglob("*"):
        if path.is_file():
            assert not np.any([word in path.read_bytes() for word in (b"/home", b"/root", b"/tmp")])
