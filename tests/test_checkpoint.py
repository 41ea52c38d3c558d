import json
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from jetbot_mjx import load_policy
from jetbot_mjx.checkpoint import (
    CheckpointError,
    CheckpointWriter,
    checkpoint_steps,
    find_checkpoint,
    load_checkpoint,
)


@pytest.fixture
def run_copy(smoke_run, tmp_path):
    return shutil.copytree(smoke_run, tmp_path / "run")


def test_a_checkpoint_explains_itself(smoke_run):
    checkpoint = load_checkpoint(smoke_run, "last")
    assert checkpoint.env_steps == 65_536
    assert checkpoint.config.task.observation == "egocentric"
    names = [field["name"] for field in checkpoint.about["layout"]]
    assert names[0] == "goal_position"
    assert checkpoint.about["versions"]["packages"]["brax"]
    assert checkpoint.about["figures"]["success_rate"] >= 0.0
    assert checkpoint.run_dir == smoke_run


def test_checkpoints_stand_at_the_stated_interval(smoke_run):
    assert checkpoint_steps(smoke_run) == [0, 16_384, 32_768, 49_152, 65_536]


def test_the_best_is_the_one_with_the_highest_success_and_of_equals_the_latest(tmp_path, smoke_run):
    params = load_checkpoint(smoke_run).params
    about = load_checkpoint(smoke_run).about
    (tmp_path / "run").mkdir()
    with CheckpointWriter(tmp_path / "run", about) as writer:
        for steps, success in ((0, 0.1), (10, 0.9), (20, 0.9), (30, 0.5)):
            writer.save(steps, params, {"success_rate": success})
    assert load_checkpoint(tmp_path / "run", "best").env_steps == 20
    assert load_checkpoint(tmp_path / "run", "last").env_steps == 30
    assert load_checkpoint(tmp_path / "run", 10).env_steps == 10


def test_what_is_read_is_what_was_written(tmp_path, smoke_run):
    checkpoint = load_checkpoint(smoke_run)
    (tmp_path / "run").mkdir()
    with CheckpointWriter(tmp_path / "run", checkpoint.about) as writer:
        writer.save(1, checkpoint.params, {"success_rate": 1.0})
    again = load_checkpoint(tmp_path / "run").params
    assert jax.tree.structure(again) == jax.tree.structure(checkpoint.params)
    jax.tree.map(np.testing.assert_array_equal, again, checkpoint.params)
    assert np.any(np.asarray(again.normalizer.mean) != 0)


_ACT = """
import sys, numpy as np
from jetbot_mjx import load_policy
obs = np.load(sys.argv[2])
np.save(sys.argv[3], np.asarray(load_policy(sys.argv[1])(obs)))
"""


def test_a_fresh_process_gives_identical_actions(smoke_run, tmp_path):
    obs = np.asarray(jax.random.normal(jax.random.PRNGKey(5), (257, 7)))
    np.save(tmp_path / "obs.npy", obs)
    subprocess.run(
        [sys.executable, "-c", _ACT, smoke_run, tmp_path / "obs.npy", tmp_path / "out.npy"],
        check=True,
    )
    here = np.asarray(load_policy(smoke_run)(obs))
    np.testing.assert_array_equal(here, np.load(tmp_path / "out.npy"))
    assert np.ptp(here, axis=0).min() > 0.1


def test_a_policy_is_deterministic_without_a_key_and_samples_with_one(smoke_run):
    policy = load_policy(smoke_run)
    obs = jnp.ones(7)
    one, two = (policy(obs, jax.random.PRNGKey(i)) for i in (0, 1))
    assert policy(obs).shape == one.shape == (2,)
    np.testing.assert_array_equal(policy(obs), policy(obs))
    assert not np.allclose(one, two)
    batched = jnp.stack([obs, 2 * obs])
    np.testing.assert_allclose(policy(batched)[0], policy(obs), rtol=1e-5)
    assert np.all(np.abs(policy(100.0 * batched)) <= 1.0)


def test_one_checkpoint_folder_stands_for_itself(smoke_run):
    folder = find_checkpoint(smoke_run, 16_384)
    assert load_checkpoint(folder).env_steps == 16_384


def refused(path, which="best"):
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path, which)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_what_is_not_there_is_refused(smoke_run, tmp_path):
    assert "no such folder" in refused(tmp_path / "nothing")
    assert "neither" in refused(tmp_path)
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    assert "saved none" in refused(tmp_path / "run")
    assert "16384" in refused(smoke_run, 123)


def test_a_foreign_checkpoint_is_refused(tmp_path):
    with ocp.StandardCheckpointer() as writer:
        writer.save(tmp_path / "000000000001" / "policy", {"weights": np.ones(3)})
    assert "not one of jetbot_mjx" in refused(tmp_path / "000000000001")


def test_another_shape_is_refused(run_copy):
    folder = find_checkpoint(run_copy, "best")
    path = folder / "about" / "metadata"
    about = json.loads(path.read_text())
    about["config"]["ppo"]["network"]["policy_hidden_layer_sizes"] = [32, 48]
    path.write_text(json.dumps(about))
    assert "cannot be read" in refused(folder)


@pytest.mark.parametrize("key", ["config", "observation_size", "format"])
def test_an_incomplete_explanation_is_refused(run_copy, key):
    folder = find_checkpoint(run_copy, "best")
    path = folder / "about" / "metadata"
    about = json.loads(path.read_text())
    del about[key]
    path.write_text(json.dumps(about))
    assert "checkpoint" in refused(folder)


@pytest.mark.parametrize("harm", ["empty", "cut", "gone"])
def test_a_damaged_checkpoint_is_refused(run_copy, harm):
    folder = find_checkpoint(run_copy, "best")
    for path in (folder / "policy").rglob("*"):
        if path.is_file() and path.parent.name == "d":
            match harm:
                case "empty":
                    path.write_bytes(b"")
                case "cut":
                    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
                case "gone":
                    path.unlink()
    assert "cannot be read" in refused(folder)
