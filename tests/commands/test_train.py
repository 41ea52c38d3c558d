"""Training end to end on the smoke configuration: what lies in the run folder, and what it says."""

import hashlib
import json
from importlib.metadata import version

import brax.training.agents.ppo.train as brax_ppo_train
import jax
import numpy as np
import pytest

from helpers import gliding
from helpers.command_modules import train
from helpers.tensorboard_files import read_events
from jetbot_mjx import load_config, wrap_for_training
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import evaluate_run
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.sb3_tags import aliases
from jetbot_mjx.training import brax_trainer, session


@pytest.fixture(scope="module")
def lines(smoke_run):
    return [json.loads(line) for line in (smoke_run / "metrics.jsonl").read_text().splitlines()]


def test_the_run_folder_holds_what_is_promised(smoke_run, root):
    assert (smoke_run / "tensorboard").is_dir()
    assert load_config(smoke_run / "config.yaml") == load_config(root / "configs" / "smoke.yaml")
    found = json.loads((smoke_run / "versions.json").read_text())
    assert found["packages"]["mujoco-mjx"] == version("mujoco-mjx")
    assert found["packages"]["mujoco"] == version("mujoco")
    assert found["device_count"] == jax.device_count()


def test_the_metrics_hold_what_is_promised(lines):
    assert [line["env_steps"] for line in lines] == [0, 16_384, 32_768, 49_152, 65_536]
    wanted = {
        "eval/success_rate",
        "eval/time_to_goal_median",
        "eval/episode_return",
        "eval/nonfinite_envs",
        "loss/total",
        "loss/policy",
        "loss/value",
        "policy/entropy",
        "policy/kl",
        "policy/learning_rate",
        "rollout/success_rate",
        "train/nonfinite_envs",
        "train/nonfinite_updates",
        "time/training_seconds",
        "time/env_steps_per_second",
        "time/compile_seconds",
        "time/wall_seconds",
    }
    assert wanted <= set(lines[-1])
    last = lines[-1]
    assert all(np.isfinite(last[name]) for name in wanted)
    walls = [line["time/wall_seconds"] for line in lines]
    assert walls == sorted(walls)
    assert last["eval/nonfinite_envs"] == 0


def test_tensorboard_has_the_curves_of_stable_baselines3_too(smoke_run, lines):
    shown = {(step, name): value for step, name, value in read_events(smoke_run / "tensorboard")}
    names = aliases(load_config(smoke_run / "config.yaml").ppo)
    assert {(65_536, name) for name in names} <= set(shown)
    last = lines[-1]
    assert shown[65_536, "train/entropy_loss"] == np.float32(-last["policy/entropy"])
    # 16 training steps of 4 passes.
    assert shown[65_536, "time/iterations"] == 16
    assert shown[65_536, "train/n_updates"] == 64
    assert not set(names) & set(last)


def test_figures_of_rollouts_are_those_of_finished_episodes(lines):
    for line in lines[1:]:
        assert 0 < line["rollout/episodes"] < 16_384 / 2
        assert 0 <= line["rollout/success_rate"] <= 1
        assert 1 <= line["rollout/episode_length"] <= 256
        assert line["train/nonfinite_envs"] == line["train/nonfinite_updates"] == 0


def test_nothing_compiles_after_the_first_interval(lines):
    assert lines[0]["time/compile_seconds"] > 0
    assert [line["time/compile_seconds"] for line in lines[2:]] == [0, 0, 0]


def test_training_learns(lines):
    success = [line["eval/success_rate"] for line in lines]
    assert success[0] < 0.2
    assert max(success) > 0.6
    assert lines[-1]["eval/episode_return"] > lines[0]["eval/episode_return"] + 0.2


def fingerprint(run_dir, which="last"):
    params = load_checkpoint(run_dir, which).params
    leaves = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params))
    return hashlib.sha256(leaves).hexdigest()


def test_the_same_seed_trains_the_same_policy(smoke_run, tmp_path, root, capsys):
    arguments = ["--config", str(root / "configs" / "smoke.yaml"), "--run-dir"]
    half = ["--set", "ppo.num_timesteps=32768"]
    exact, first = [], smoke_run
    if jax.default_backend() != "cpu":
        # Its atomics add up in any order, and its kernels are chosen by the clock.
        exact, first = ["--set", "deterministic=true"], tmp_path / "first"
        assert train.main([*arguments, str(first), *exact]) == 0
    assert train.main([*arguments, str(tmp_path / "again"), *half, *exact]) == 0
    assert fingerprint(tmp_path / "again") == fingerprint(first, 32_768)
    assert str(tmp_path / "again") in capsys.readouterr().out
    short = ["--set", "ppo.num_timesteps=16384", "--seed", "1"]
    assert train.main([*arguments, str(tmp_path / "other"), *short]) == 0
    assert fingerprint(tmp_path / "other") != fingerprint(first, 16_384)
    assert load_config(tmp_path / "other" / "config.yaml").seed == 1


@pytest.mark.slow
def test_the_stock_trainer_leaves_the_same_kind_of_run(root, tmp_path, capsys):
    arguments = ["--config", str(root / "configs" / "smoke.yaml"), "--set", "trainer=brax"]
    arguments += ["--set", "ppo.learning_rate_schedule=LINEAR"]
    arguments += ["--set", "ppo.num_timesteps=16384", "--run-dir", str(tmp_path / "run")]
    with gliding.everywhere():
        assert train.main(arguments) == 0
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["env_steps"] for line in lines] == [0, 16_384]
    assert "loss/policy" in json.loads(lines[-1])
    # Brax itself has no such schedule.
    assert json.loads(lines[-1])["policy/learning_rate"] == 0.0
    assert load_checkpoint(tmp_path / "run", "last").env_steps == 16_384
    with pytest.raises(UserError, match="trainer = 'brax', which cannot be continued"):
        train.main(arguments)


@pytest.mark.slow
def test_training_stops_at_the_success_asked_for(root, tmp_path, capsys):
    config = load_config(root / "configs" / "smoke.yaml", ["stop_at_success=0.01"])
    result = session.run(config, tmp_path / "run")
    assert result.finished
    assert result.standings[0].env_steps < 65_536
    assert result.standings[0].last.success_rate >= 0.01


# The trainer `brax`, above, takes it as that too.
@pytest.mark.slow
def test_stock_brax_takes_wrap_for_training_as_its_wrap_env_fn(root):
    config = load_config(root / "configs" / "smoke.yaml")
    with brax_trainer.device_put_replicated():
        _, params, _ = brax_ppo_train.train(
            environment=gliding.Gliding(config),
            num_timesteps=1,
            num_envs=8,
            batch_size=8,
            num_minibatches=1,
            num_updates_per_batch=1,
            unroll_length=2,
            episode_length=8,
            num_evals=2,
            num_eval_envs=8,
            wrap_env_fn=wrap_for_training,
        )
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(params))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"), [("jetbot_egocentric.yaml", 0.99), ("jetbot.yaml", 0.98)]
)
def test_the_shipped_configurations_reach_their_success(name, least, root, tmp_path):
    session.run(load_config(root / "configs" / name), tmp_path / "run")
    assert evaluate_run(tmp_path / "run").policy.success_rate >= least
