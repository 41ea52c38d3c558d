"""Training from the camera, on a robot that glides: kills, seeds, devices, and every command."""

import json
import os
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest

from helpers import gliding
from helpers.further import slow_fixture

pytest.importorskip("gymnasium")

from helpers.command_modules import evaluate, train
from jetbot_mjx import check_env, load_policy, make_env
from jetbot_mjx.agents import NanDump
from jetbot_mjx.config import ConfigError, parse_config
from jetbot_mjx.envs.camera.wrapper import NUMBERS, PIXELS
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import InvalidError, UserError
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, read_about
from jetbot_mjx.runs.nan_dump import load_nan_dump, replay_nan_dump, save_nan_dump

STEP = 512  # environment steps in one training step
SETTINGS = {
    "checkpoint_interval": STEP,
    "tensorboard": False,
    "task": {"observation": "camera+egocentric", "episode_length": 24},
    "camera": {"width": 16, "height": 16, "samples": 1, "frames": 2, "colour": "grey"},
    # Some of the looks; what remains of an episode, such as late images, is part of its state.
    "randomization": {"exposure": [0.8, 1.2], "camera_delay": [0, 2], "frame_drop": [0.0, 0.2]},
    "ppo": {
        "num_timesteps": 3 * STEP,
        "num_envs": 16,
        "unroll_length": 16,
        "batch_size": 16,
        "num_minibatches": 2,
        "num_updates_per_batch": 1,
        "learning_rate_schedule": "NONE",
        "network": {
            "cnn": "tiny",
            "policy_hidden_layer_sizes": [8],
            "value_hidden_layer_sizes": [8],
        },
    },
    "evaluation": {"episodes": 8},
}


@pytest.fixture(scope="module", autouse=True)
def glide():
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
def config_file(tmp_path_factory):
    """A configuration as a file; JSON is YAML."""
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    path.write_text(json.dumps(SETTINGS))
    return path


@slow_fixture(scope="module")
def run(config_file):
    """A run that was never stopped."""
    run_dir = config_file.with_name("whole")
    train.main(["--config", str(config_file), "--run-dir", str(run_dir)])
    return run_dir


def sums(run_dir, env_steps=3 * STEP):
    """SHA-256 of the policy and of everything else that training goes on from."""
    return read_about(checkpoint_path(run_dir, env_steps))["sha256"]


@pytest.mark.slow
def test_an_interrupted_training_ends_with_the_same_bits(run, config_file):
    parts = shutil.copytree(run, config_file.with_name("parts"))
    for steps in (2 * STEP, 3 * STEP):
        shutil.rmtree(checkpoint_path(parts, steps))
    train.main(["--resume", str(parts)])
    assert sums(parts) == sums(run)
    # It learnt at all, images too.
    assert sums(run) != sums(run, STEP)


@pytest.mark.slow
def test_a_checkpoint_tells_what_of_the_training_was_slow(run):
    told = read_about(checkpoint_path(run, 3 * STEP))["fallbacks"]
    assert told == [["ppo.update", "it takes observations without images"]]
    assert "slow: ppo.update: " in (run / "train.log").read_text("utf-8")


def test_a_policy_takes_what_it_was_trained_on_and_nothing_else(run):
    policy = load_policy(run)
    images = np.random.default_rng(0).integers(0, 256, (5, 16, 16, 2), np.uint8)
    numbers = np.zeros((5, 7), np.float32)
    actions = policy({PIXELS: images, NUMBERS: numbers})
    assert actions.shape == (5, 2)
    one = policy({PIXELS: images[0], NUMBERS: numbers[0]})
    np.testing.assert_allclose(one, actions[0], rtol=1e-5, atol=1e-6)
    # The action depends on the image.
    assert not np.array_equal(policy({PIXELS: images[:, ::-1], NUMBERS: numbers}), actions)

    wrong = {
        "an array": (numbers, "expected {pixels/front: [16, 16, 2], state: [7]}; got shape [5, 7]"),
        "no numbers": ({PIXELS: images}, "got {pixels/front: [5, 16, 16, 2]}"),
        "a size": ({PIXELS: images[:, :8], NUMBERS: numbers}, "got {pixels/front: [5, 8, 16, 2]"),
        "floats": ({PIXELS: images / 255, NUMBERS: numbers}, "it should be uint8, 0 to 255"),
    }
    for observation, message in wrong.values():
        with pytest.raises(InvalidError) as error:
            policy(observation)
        assert message in str(error.value)
        assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_a_policy_is_evaluated_in_its_environment(run, capsys):
    checkpoint = load_checkpoint(run, "last")
    env = checkpoint.make_env()
    assert env.observation_size == {PIXELS: (16, 16, 2), NUMBERS: (7,)}
    assert evaluate.main([str(run), "--episodes", "4"]) == 0


@pytest.mark.slow
def test_several_seeds_train_at_once(config_file, run):
    folder = config_file.with_name("seeds")
    arguments = ["--set", "seeds=2", "--set", f"ppo.num_timesteps={STEP}"]
    train.main(["--config", str(config_file), "--run-dir", str(folder), *arguments])
    first, second = (sums(folder / f"seed-{seed}", STEP)["policy"] for seed in (0, 1))
    assert first != second


@pytest.mark.slow
def test_two_devices_train(config_file):
    run_dir = config_file.with_name("two")
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    arguments = ["--run-dir", run_dir, "--set", f"ppo.num_timesteps={STEP}"]
    done = subprocess.run(
        [sys.executable, *gliding.program("train"), "--config", config_file, *arguments],
        env={**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags.strip()},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "on 2 x cpu" in done.stdout
    # A policy of all devices, which any number of devices can use.
    assert sums(run_dir, STEP)
    assert load_checkpoint(run_dir).env_steps == STEP


@pytest.mark.slow
def test_a_task_whose_policy_sees_passes_its_checks(config_file, capsys):
    arguments = ["--set", "task.observation=camera", "--set", "camera.samples=2"]
    assert check_env.main(["--config", str(config_file), *arguments]) == 0
    assert capsys.readouterr().out.endswith("jetbot_mjx:GoalTask: no errors\n")


# Refusals.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"init_from": "pretrained:jetbot_egocentric"}, "cannot begin with another's"),
        (
            {"trainer": "brax", "ppo": {"network": {"shared_cnn": True}}},
            "ppo.network.shared_cnn = true is not supported by trainer = 'brax'",
        ),
    ],
)
def test_a_training_that_cannot_see_is_refused_in_one_line(changes, message):
    with pytest.raises(ConfigError) as error:
        parse_config({"task": {"observation": "camera"}, **changes})
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_images_too_small_for_the_network_are_refused_before_a_run_begins(config_file, capsys):
    run_dir = config_file.with_name("none")
    arguments = ["--set", "ppo.network.cnn=nature", "--run-dir", str(run_dir)]
    with pytest.raises(UserError, match=r"^camera\.width = 16 and camera\.height = 16"):
        train.main(["--config", str(config_file), *arguments])
    assert not run_dir.exists()


@pytest.mark.slow
@pytest.mark.parametrize("randomization", [{}, {"start_x": [0.0, 0.1]}])
def test_a_nan_dump_with_images_is_replayed(tmp_path, randomization):
    config = parse_config(SETTINGS | {"randomization": randomization})
    env = make_env(config)
    wrapped = wrap_for_training(env, config.task.episode_length)
    state = jax.tree.map(lambda x: x[0], jax.jit(wrapped.reset)(report_keys(1)))
    actions = np.full((16, 2), 0.5, np.float32)
    actions[1] = np.nan
    dump = NanDump(found=True, env_state=state, actions=actions, step=np.int32(1))
    path = save_nan_dump(tmp_path, config, STEP, jax.device_get(dump))
    stored = load_nan_dump(path)
    np.testing.assert_array_equal(stored.nan_dump.env_state.obs[PIXELS], state.obs[PIXELS])
    first, second = replay_nan_dump(stored, env)
    assert first.nonfinite == []
    assert "reward" in second.nonfinite
