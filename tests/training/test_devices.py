"""Training on eight devices: a second process, in which JAX takes the CPU for eight of them."""

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import gliding
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_modules import train
from jax.sharding import Mesh, PartitionSpec
from test_ppo import OBS, SIZE, TINY, beginning, furthest, lines, made_up, with_ppo

from jetbot_mjx.agents.ppo import PPO
from jetbot_mjx.config import ConfigError, RandomizationConfig, load_config, parse_config
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, digest, read_about
from jetbot_mjx.runs.resume import resume, to_trees
from jetbot_mjx.training import session
from jetbot_mjx.training.ppo_trainer import CompiledTrainer, build_ppo

DEVICES = 8
STEPS = 3
SMOKE = Path(__file__).parents[2] / "configs" / "smoke.yaml"


@pytest.fixture(scope="module", autouse=True)
def glide():
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
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


TELLER = f"import sys; {gliding.LAZILY}; import test_devices as t; t.tell(*sys.argv[1:])"


@gliding.everywhere()
def tell(*paths):
    """The other process: everything that eight devices are needed for."""
    one, eight, answer = map(Path, paths)
    config = load_config(SMOKE)
    known = {"device_count": jax.device_count(), "averaging": averaging()}
    known |= trained_program(config)
    known["robots"] = robots(config)
    known["restored"] = restored(one)
    known["went_on"] = said("--resume", one, "--set", f"ppo.num_timesteps={2 * SIZE}")
    said("--config", SMOKE, "--run-dir", eight, "--set", "checkpoint_interval=32768")
    answer.write_text(json.dumps(known))


def said(*arguments):
    """What the training command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as stream:
        assert train.main([str(argument) for argument in arguments]) == 0
    return stream.getvalue()


def trained_program(config):
    program = CompiledTrainer.from_config(config, make_env(config))
    begun = program.init()
    (first,) = program.get(begun)
    advance = program.compile()
    state, faults = advance(begun, STEPS, False)
    (last,) = program.get(state)
    shards = state.env_state.words.addressable_shards

    everyone_the_same = first.replace(
        env_state=jax.tree.map(lambda x: np.repeat(x[:1], x.shape[0], axis=0), first.env_state)
    )
    driven, _ = advance(program.put([everyone_the_same]), 1, False)
    each_device_s_first = np.asarray(driven.env_state.unpack().pipeline_state.qpos)[
        0, :: config.ppo.num_envs // DEVICES
    ]
    shared = state.replace(env_state=None)
    return {
        "shards": sorted({(shard.device.id, *shard.data.shape) for shard in shards}),
        "copies_differ": [
            jax.tree_util.keystr(path)
            for path, leaf in jax.tree_util.tree_leaves_with_path(shared)
            if len({np.asarray(shard.data).tobytes() for shard in leaf.addressable_shards}) > 1
        ],
        "copies": min(len(leaf.addressable_shards) for leaf in jax.tree.leaves(shared)),
        "normalizer_count": int(last.normalizer.count.to_numpy()),
        "env_steps": int(last.env_steps.to_numpy()),
        "goals": len(np.unique(first.env_state.goal, axis=0)),
        "goals_later": len(np.unique(last.env_state.goal, axis=0)),
        "ways": len(np.unique(each_device_s_first, axis=0)),
        "moved": furthest(first.params, last.params).item(),
        "finite": all(bool(np.all(np.isfinite(leaf))) for leaf in jax.tree.leaves(last)),
        "faults": np.asarray(faults.found).shape,
    }


def robots(config):
    """What was drawn for the environments, and each one's key of noise."""
    drawn = {"friction": (0.4, 1.2), "motor_gain": (0.9, 1.1), "yaw_noise": (0.0, 0.1)}
    config = config.model_copy(update={"randomization": RandomizationConfig(**drawn)})
    env_state = CompiledTrainer.from_config(config, make_env(config)).init().env_state
    episode_params = env_state.unpack().episode_params
    return {
        "shards": [shard.data.shape[:2] for shard in env_state.words.addressable_shards],
        "drawn": np.asarray(episode_params.drawn)[0].tolist(),
        "keys": np.asarray(episode_params.sensors.key)[0].tolist(),
    }


def averaging():
    """Adam's first moment after one update: of the whole batch, of each half, and of two devices.

    Without normalised advantages and the entropy's samples, the loss is a mean over the batch.
    """
    settings = TINY | {"batch_size": 32, "num_minibatches": 1, "max_grad_norm": None}
    settings |= {"normalize_advantage": False, "entropy_cost": 0.0}
    config = parse_config({"task": {"observation": "egocentric"}, "ppo": settings})
    among = build_ppo(config, make_env(config))
    env = wrap_for_training(make_env(config), config.task.episode_length)
    alone = PPO(config.ppo, env, among.networks)
    params, optimizer_state, normalizer = beginning(alone)
    assert normalizer.mean.shape == (OBS,)
    data, key = made_up(alone), jax.random.PRNGKey(0)
    whole = PartitionSpec()
    sharded = jax.shard_map(
        among.update,
        mesh=Mesh(np.array(jax.devices()[:2]), ("devices",)),
        in_specs=(whole, whole, whole, PartitionSpec("devices"), whole),
        out_specs=whole,
        check_vma=False,
    )

    def moment(update, data):
        """The moment, and the total loss, the first of `LOSSES`."""
        _, state, metrics = jax.jit(update)(params, optimizer_state, normalizer, data, key)
        return jax.device_get((state[-1].inner_state[0].mu, metrics[0]))

    (all_of_it, loss), (together, same_loss) = moment(alone.update, data), moment(sharded, data)
    half, _ = moment(alone.update, jax.tree.map(lambda x: x[:16], data))
    return {
        "difference": furthest(all_of_it, together).item(),
        "of_a_half": furthest(all_of_it, half).item(),
        "losses": [float(loss), float(same_loss)],
    }


def restored(run_dir):
    """SHA-256 of the last checkpoint's trees: as they were stored, and after the devices."""
    checkpoint = load_checkpoint(run_dir, "last")
    program = CompiledTrainer.from_config(checkpoint.config, make_env(checkpoint.config))
    resumption = resume([run_dir], [checkpoint.config], program.template())
    (state,) = program.get(program.put(resumption.states))
    stored = read_about(checkpoint_path(run_dir, resumption.env_steps))["sha256"]
    return {name: [stored[name], digest(tree)] for name, tree in to_trees(state).items()}


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


def test_what_one_device_saved_goes_on_on_eight(told, on_one):
    for stored, found in told["restored"].values():
        assert stored == found
    assert f"resuming after {SIZE:,} steps" in told["went_on"]
    assert "device_count 1, now 8" in told["went_on"]
    assert [line["env_steps"] for line in lines(on_one)] == [0, SIZE, 2 * SIZE]


def test_what_eight_devices_saved_goes_on_on_one(told, on_one):
    run_dir = on_one.with_name("eight")
    for stored, found in restored(run_dir).values():
        assert stored == found
    printed = said("--resume", run_dir, "--set", f"ppo.num_timesteps={65_536 + SIZE}")
    assert "resuming after 65,536 steps" in printed
    assert "device_count 8, now 1" in printed
    assert lines(run_dir)[-1]["env_steps"] == 65_536 + SIZE
    state = jax.tree.leaves(load_checkpoint(run_dir, "last").params)
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in state)
