"""Faults around and inside of a training: one line each, nothing lost, nothing half-written."""

import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from jetbot_mjx import envs
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps
from jetbot_mjx.training import session
from jetbot_mjx.training.ppo_trainer import CompiledTrainer
from jetbot_mjx.training.run_recorder import SeedRecorder

SETTINGS = ["evaluation.episodes=16", "checkpoint_interval=8_192", "ppo.num_timesteps=32_768"]


@pytest.fixture(scope="module")
def config(root):
    return load_config(root / "configs" / "smoke.yaml", SETTINGS)


@pytest.fixture(scope="module")
def undisturbed(config, tmp_path_factory):
    """A function that trains into a folder, and the fingerprint of a training without a fault."""

    def train(folder):
        with gliding.everywhere():
            return session.run(config, folder)

    return train, train(tmp_path_factory.mktemp("faults") / "run").fingerprints


def failing(function, at, error):
    """A function that raises an error at its n-th call."""
    calls = []

    def fail(*given, **named):
        calls.append(1)
        if len(calls) == at:
            raise error
        return function(*given, **named)

    return fail


def failing_steps(at, error):
    compiled = CompiledTrainer.compile

    def compile_(self):
        return failing(compiled(self), at, error)

    return CompiledTrainer, "compile", compile_


GONE = jax.errors.JaxRuntimeError("INTERNAL: CUDA_ERROR_LAUNCH_FAILED: unspecified launch failure")
FULL = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes\nmore")

PHASES = {
    "the first states": lambda error: (
        CompiledTrainer,
        "init_later",
        lambda self: failing(lambda: None, 1, error),
    ),
    "compiling": lambda error: (
        CompiledTrainer,
        "compile",
        failing(CompiledTrainer.compile, 1, error),
    ),
    "the first training step": lambda error: failing_steps(1, error),
    "a later training step": lambda error: failing_steps(4, error),
    "an evaluation": lambda error: (Evaluator, "run", failing(Evaluator.run, 3, error)),
    "a checkpoint": lambda error: (SeedRecorder, "save", failing(SeedRecorder.save, 3, error)),
}


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize(
    ("error", "said"),
    [(GONE, "the device failed"), (FULL, "memory")],
    ids=["gone", "full"],
)
def test_a_device_that_fails_costs_one_line_and_no_checkpoint(
    undisturbed, tmp_path, monkeypatch, phase, error, said
):
    train, fingerprints = undisturbed
    with monkeypatch.context() as patch:
        patch.setattr(*PHASES[phase](error))
        with pytest.raises(UserError, match=said) as caught:
            train(tmp_path / "run")
    assert "\n" not in str(caught.value)
    known = checkpoint_steps(tmp_path / "run")
    if error is GONE and known:
        steps, folder = re.findall(r"after ([\d,]+) steps.*--resume (\S+)`", str(caught.value))[0]
        assert (int(steps.replace(",", "")), folder) == (known[-1], str(tmp_path / "run"))
    if phase in ("an evaluation", "a checkpoint"):
        assert known == [0, 8_192]
    assert train(tmp_path / "run").fingerprints == fingerprints


def test_a_nan_in_one_of_65536_robots_stays_there(config):
    env = envs.wrap_for_training(gliding.Gliding(config), config.task.episode_length)
    count, sick = 65_536, 40_000

    @jax.jit
    def run(spoil):
        state = env.reset(jax.random.split(jax.random.PRNGKey(0), count))
        physics = state.pipeline_state
        qpos = physics.qpos.at[sick].set(jnp.where(spoil, jnp.nan, physics.qpos[sick]))
        state = state.replace(pipeline_state=physics.replace(qpos=qpos))
        return env.step(state, jnp.ones((count, env.action_size)))

    well, ill = (jax.device_get(run(spoil)) for spoil in (False, True))
    assert np.flatnonzero(ill.metrics["nonfinite_envs"]).tolist() == [sick]
    assert not well.metrics["nonfinite_envs"].any()
    for one, other in zip(*map(jax.tree.leaves, (well, ill)), strict=True):
        assert np.isfinite(other).all()
        others = np.arange(count) != sick
        assert np.array_equal(one[others], other[others])


@pytest.fixture
def open_folder():
    """A folder that other users reach; those of pytest are closed to them."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


ODD = """import os, runpy
os.umask(0o777)
runpy.run_module("jetbot_mjx.train", run_name="__main__")
"""


@pytest.mark.slow
def test_a_training_in_an_odd_place(open_folder):
    """No home, no name, one core, no shared memory, code that cannot be written, an odd folder."""
    place = open_folder / "with blanks" / "and a\nnew line"
    place.mkdir(parents=True)
    program = place / "program.py"
    program.write_text(ODD)
    names = ("HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR", "USER")
    environment = {key: x for key, x in os.environ.items() if key not in names}
    command = [sys.executable, str(program), "smoke", "--run-dir", "a run\nx"]
    command += [f"--set={one}" for one in SETTINGS]
    is_root = os.geteuid() == 0 and shutil.which("setpriv") and shutil.which("unshare")
    if is_root:
        # Whoever has this number has no name, and may write nowhere but here.
        for folder in (place, place.parent, open_folder):
            folder.chmod(0o777)
        full = "mount -t tmpfs -o size=4k none /dev/shm && head -c 4096 /dev/zero > /dev/shm/x; "
        own = ["setpriv", "--reuid=54321", "--regid=54321", "--clear-groups", *command]
        command = ["unshare", "--mount", "sh", "-c", full + 'exec "$@"', "sh", *own]
    if shutil.which("taskset"):
        command = ["taskset", "--cpu-list", "0", *command]
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert "no home folder: set HOME" in done.stderr + done.stdout
    run = place / "a run\nx"
    assert checkpoint_steps(run) == [0, 8_192, 16_384, 24_576, 32_768]
    own = stat.S_IRUSR | stat.S_IWUSR
    assert all(path.stat().st_mode & own == own for path in run.rglob("*"))
    assert not any(path.stat().st_mode & 0o077 for path in run.rglob("*"))
