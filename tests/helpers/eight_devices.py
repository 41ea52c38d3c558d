"""The second process of `test_eight_devices`, in which JAX takes the CPU for eight devices."""

import contextlib
import io
import json
import sys
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from helpers import gliding
from helpers.command_modules import train
from helpers.small_ppo import OBS, SIZE, TINY, beginning, furthest, made_up
from jetbot_mjx.agents.ppo import PPO
from jetbot_mjx.config import RandomizationConfig, load_config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, digest, read_about
from jetbot_mjx.runs.resumption import resume, to_trees
from jetbot_mjx.training.ppo_trainer import CompiledTrainer, build_ppo

DEVICES = 8
STEPS = 3
SMOKE = Path(__file__).parents[2] / "configs" / "smoke.yaml"


@gliding.everywhere()
def main():
    """Write to the last path everything that eight devices are needed for.

    The first path is a run to go on with, the second a folder for another run.
    """
    one, eight, answer = map(Path, sys.argv[1:])
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
    program = CompiledTrainer.from_setup(Setup(config))
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
    env_state = CompiledTrainer.from_setup(Setup(config)).init().env_state
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
    among = build_ppo(Setup(config))
    env = wrap_for_training(make_env(config), config.task.episode_length)
    alone = PPO(config.ppo, env, among.networks)
    params, optimizer_state, normalizer = beginning(alone)
    assert normalizer.mean.shape == (OBS,)
    data, key = made_up(alone), jax.random.PRNGKey(0)
    whole = PartitionSpec()

    def update_among(*given):
        params, optimizer_state, totals = among.learner.update(*given)
        return params, optimizer_state, jax.lax.pmean(totals, "devices")

    sharded = jax.shard_map(
        update_among,
        mesh=Mesh(np.array(jax.devices()[:2]), ("devices",)),
        in_specs=(whole, whole, whole, PartitionSpec("devices"), whole),
        out_specs=whole,
        check_vma=False,
    )

    def moment(update, data):
        """The moment, and the total loss, the first of `LOSSES`."""
        _, state, totals = jax.jit(update)(params, optimizer_state, normalizer, data, key)
        return jax.device_get((state[-1].inner_state[0].mu, totals[0]))

    update = alone.learner.update
    (all_of_it, loss), (together, same_loss) = moment(update, data), moment(sharded, data)
    half, _ = moment(update, jax.tree.map(lambda x: x[:16], data))
    return {
        "difference": furthest(all_of_it, together).item(),
        "of_a_half": furthest(all_of_it, half).item(),
        "losses": [float(loss), float(same_loss)],
    }


def restored(run_dir):
    """SHA-256 of the last checkpoint's trees: as they were stored, and after the devices."""
    checkpoint = load_checkpoint(run_dir, "last")
    program = CompiledTrainer.from_setup(Setup(checkpoint.config))
    resumption = resume([run_dir], [checkpoint.config], program.template())
    (state,) = program.get(program.put(resumption.states))
    stored = read_about(checkpoint_path(run_dir, resumption.env_steps))["sha256"]
    return {name: [stored[name], digest(tree)] for name, tree in to_trees(state).items()}
