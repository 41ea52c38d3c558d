"""The bits of a training on CPUs do not depend on how many cores there are."""

import os
import re
import subprocess
import sys

import pytest

from helpers import gliding

pytestmark = [
    pytest.mark.cpu,
    pytest.mark.skipif(
        not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2,
        reason="it needs two cores, and a system that keeps a process from one of them",
    ),
]

SETTINGS = [
    "ppo.num_envs=512",
    "ppo.batch_size=64",
    "ppo.num_minibatches=8",
    "ppo.unroll_length=16",
    "ppo.num_timesteps=32768",
    "ppo.network.policy_hidden_layer_sizes=[64, 64]",
    "ppo.network.value_hidden_layer_sizes=[64, 64]",
    "checkpoint_interval=32768",
    "evaluation.episodes=16",
]


def train(root, folder, cores):
    arguments = [word for setting in SETTINGS for word in ("--set", setting)]
    config = root / "configs" / "smoke.yaml"
    option, text, command = gliding.program("train")
    text = f"import os; os.sched_setaffinity(0, {cores}); {text}"
    return subprocess.Popen(
        [
            *(sys.executable, option, text, command),
            *("--config", str(config), "--run-dir", str(folder / "run"), *arguments),
        ],
        env={**os.environ, "XDG_CACHE_HOME": str(folder)},
        stdout=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_one_core_and_two_train_to_the_same_bits(root, tmp_path):
    cores = sorted(os.sched_getaffinity(0))[:2]
    trainings = [train(root, tmp_path / f"{n}", cores[:n]) for n in (1, 2)]
    printed = [training.communicate()[0] for training in trainings]
    assert [training.returncode for training in trainings] == [0, 0]
    hashes = [re.findall(r"sha256 (\w{64})", text) for text in printed]
    assert len(hashes[0]) == 1
    assert hashes[0] == hashes[1]
