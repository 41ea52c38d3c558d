"""`replay` refuses files that are not NaN dumps, and shows of each step what there is."""

import json
import os
from pathlib import Path

import jax
import numpy as np
import pytest

from jetbot_mjx import replay
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.runs import nan_dump
from jetbot_mjx.runs.nan_dump import ReplayStep, format_step, replay_header


def test_replay_refuses_a_file_that_is_no_nan_dump(refused, here, tmp_path):
    assert "nothing.npz does not exist: give a file of a run's nan_dumps/" in refused(
        replay, here / "nothing.npz"
    )
    for name, write in {
        "text.npz": lambda path: path.write_text("no archive"),
        "other.npz": lambda path: np.savez(path, a=np.ones(3)),
        "empty.npz": lambda path: path.touch(),
    }.items():
        write(tmp_path / name)
        said = refused(replay, tmp_path / name)
        assert f"{name} is not a NaN dump of a training: give a file of a run's nan_dumps/" in said


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo], ids=["folder", "pipe"])
def test_replay_refuses_a_folder_and_a_pipe(refused, tmp_path, make):
    make(tmp_path / "dump.npz")
    assert "dump.npz is not a NaN dump of a training" in refused(replay, tmp_path / "dump.npz")


@pytest.mark.parametrize("value", [np.zeros((10**4, 3)), np.array("x")], ids=["shape", "dtype"])
def test_replay_refuses_arrays_of_another_kind(refused, tmp_path, value):
    config = parse_config({})
    arrays = nan_dump.flatten(nan_dump._template(config, None))
    arrays = {name: np.zeros(np.shape(leaf), np.float32) for name, leaf in arrays.items()}
    about = {"format": nan_dump._FORMAT, "config": config.model_dump(mode="json"), "env_steps": 1}
    arrays |= {"actions": value, "about": np.array(json.dumps(about))}
    np.savez(tmp_path / "dump.npz", **arrays)
    line = refused(replay, tmp_path / "dump.npz")
    assert "dump.npz does not fit its task: actions is " in line


def test_the_table_of_an_environment_of_ones_own_has_no_pose():
    env = make_env(parse_config({"environment": "helpers.own_environments:Point"}))
    state = env.reset(jax.random.PRNGKey(0))
    step = ReplayStep(np.float32([0.5]), state, ["pipeline_state.kept.x", "reward"])
    assert replay_header(env).split() == ["step", "action", "not", "finite"]
    assert format_step(8, step).split() == ["8", "+0.500", "x,", "reward"]
    assert replay_header(env).index("not") == format_step(8, step).index("x,")
