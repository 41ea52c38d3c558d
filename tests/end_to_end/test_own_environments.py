"""Trainings in an environment of one's own survive kills, and use several devices and seeds."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import ROOT
from benchmarks.reliability import torture
from benchmarks.reliability.torture import SETTINGS, Aim
from benchmarks.throughput.environments import LIBRARIES
from helpers import point_mass
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps

CLASSES = ("PointMass", "Choosing")
EXAMPLE = ROOT / "examples" / "cartpole.py"
OTHERS = {**LIBRARIES, "Cartpole": {"environment": f"{EXAMPLE.name}:Cartpole"}}
"""Settings of the environments that are not a class of the tests."""
LONGER = (*SETTINGS, "checkpoint_interval=4_096", "ppo.num_timesteps=32_768")


@pytest.fixture(scope="module")
def config(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("configs") / "own.yaml"
    shutil.copy(EXAMPLE, path.parent)
    if request.param in CLASSES:
        text = point_mass.config(request.param).to_yaml()
    else:
        settings = OTHERS[request.param]
        if request.param in LIBRARIES:
            pytest.importorskip(settings["environment"].partition(":")[0])
        text = json.dumps({**point_mass.TINY, **settings})
    path.write_text(text)
    return path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # those of the libraries
@pytest.mark.parametrize("config", [*CLASSES, *OTHERS], indirect=True)
def test_a_training_that_was_killed_ends_as_if_it_had_never_been(config, tmp_path):
    template = torture.make_template(LONGER, config)
    undisturbed = torture.finish(tmp_path / "undisturbed", LONGER, config=config)
    run = tmp_path / "killed"
    for aim in (Aim("saving", 0.0, 2), Aim("saved", 0.01)):
        torture.kill(run, LONGER, aim, template, config=config)
    assert 0 < checkpoint_steps(run)[-1] < 32_768, "the last start must be from the middle"
    killed = torture.finish(run, LONGER, config=config)
    assert torture.differences(undisturbed, killed) == []


@pytest.mark.slow
@pytest.mark.parametrize("config", CLASSES, indirect=True)
def test_two_seeds_train_on_two_devices(config, tmp_path):
    settings = ["--set", "cpu_devices=2", "--set", "seeds=2", "--run-dir", str(tmp_path / "run")]
    command = [sys.executable, "-m", "jetbot_mjx.train", "--config", str(config), *settings]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "on 2 x cpu" in done.stdout
    kernels = [
        load_checkpoint(tmp_path / "run" / f"seed-{seed}", "last").params.policy["params"][
            "hidden_0"
        ]["kernel"]
        for seed in range(2)
    ]
    assert np.all(np.isfinite(kernels))
    assert np.any(kernels[0] != kernels[1])
