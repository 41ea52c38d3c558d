"""Training on eight devices: a second process, in which JAX takes the CPU for eight of them."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from helpers.eight_devices import DEVICES, SMOKE, STEPS, restored, said
from helpers.further import slow_fixture
from helpers.small_ppo import SIZE, lines, with_ppo
from jetbot_mjx.config import ConfigError, load_config
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.training import session


@pytest.fixture(scope="module", autouse=True)
def glide():
    with gliding.everywhere():
        yield


@slow_fixture(scope="module")
def on_one(tmp_path_factory):
    """A run of one training step on one device, which the other process goes on with."""
    run_dir = tmp_path_factory.mktemp("devices") / "one"
    session.run(with_ppo(load_config(SMOKE), num_timesteps=SIZE, checkpoint_interval=SIZE), run_dir)
    return run_dir


@pytest.mark.cpu
def test_a_cpu_that_is_divided_otherwise_is_refused_before_a_folder_is_made(tmp_path):
    with pytest.raises(ConfigError, match="cpu_devices = 5: JAX has already started with 1"):
        session.run(load_config(SMOKE, ["cpu_devices=5"]), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.fixture(scope="module")
def told(on_one):
    """What the process on eight devices tells; beside `one`, it leaves the run `eight`."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={DEVICES}"
    answer = on_one.with_name("told.json")
    done = subprocess.run(
        [sys.executable, "-c", TELLER, str(on_one), str(on_one.with_name("eight")), str(answer)],
        env={**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags.strip()},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(answer.read_text())


TELLER = f"{gliding.LAZILY}; from helpers import eight_devices; eight_devices.main()"


@pytest.mark.slow
def test_every_device_draws_robots_and_noise_of_its_own(told):
    robots = told["robots"]
    envs = load_config(SMOKE).ppo.num_envs
    assert robots["shards"] == [[1, envs // DEVICES]] * DEVICES
    for column in np.transpose(robots["drawn"]):
        assert len(set(column.tolist())) == envs
    assert len({tuple(key) for key in robots["keys"]}) == envs


def test_the_environments_are_dealt_over_the_devices(told):
    assert told["device_count"] == DEVICES
    assert [shard[:3] for shard in told["shards"]] == [
        [device, 1, 128 // DEVICES] for device in range(DEVICES)
    ]
    assert told["faults"] == [DEVICES, 1]


def test_every_device_holds_the_same_parameters(told):
    assert told["copies"] == DEVICES
    assert told["copies_differ"] == []
    assert told["finite"]
    assert told["moved"] > 0.01


def test_the_normalizer_has_seen_what_all_devices_saw(told):
    assert told["normalizer_count"] == told["env_steps"] == STEPS * SIZE


def test_the_devices_draw_goals_and_noise_of_their_own(told):
    assert told["goals"] == told["goals_later"] == 128
    assert told["ways"] == DEVICES


def test_devices_average_to_the_gradient_of_the_whole_batch(told):
    found = told["averaging"]
    assert found["of_a_half"] > 1e-3
    # Sums of 128 terms, added up in another order.
    assert found["difference"] < 1e-3 * found["of_a_half"]
    assert found["losses"][0] == pytest.approx(found["losses"][1], rel=1e-5)


def test_eight_devices_learn(told, on_one):
    history = lines(on_one.with_name("eight"))
    assert history[-1]["env_steps"] == 65_536
    assert history[0]["eval/success_rate"] < 0.2
    assert history[-1]["eval/success_rate"] > 0.4


def test_a_run_of_one_device_resumes_on_eight(told, on_one):
    for stored, found in told["restored"].values():
        assert stored == found
    assert f"resuming after {SIZE:,} steps" in told["went_on"]
    assert "device_count 1, now 8" in told["went_on"]
    assert [line["env_steps"] for line in lines(on_one)] == [0, SIZE, 2 * SIZE]


@pytest.mark.slow
def test_a_run_of_eight_devices_resumes_on_one(told, on_one):
    run_dir = on_one.with_name("eight")
    for stored, found in restored(run_dir).values():
        assert stored == found
    printed = said("--resume", run_dir, "--set", f"ppo.num_timesteps={65_536 + SIZE}")
    assert "resuming after 65,536 steps" in printed
    assert "device_count 8, now 1" in printed
    assert lines(run_dir)[-1]["env_steps"] == 65_536 + SIZE
    state = jax.tree.leaves(load_checkpoint(run_dir, "last").params)
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in state)
