"""Robots drawn for every episode: each quantity within its range, and different everywhere."""

import functools
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from helpers.command_modules import train
from jetbot_mjx import make_env
from jetbot_mjx.config import (
    LookParams,
    RandomizationConfig,
    RobotParams,
    load_config,
    parse_config,
)
from jetbot_mjx.devices import compiler_options
from jetbot_mjx.envs.domain_randomization import DomainRandomizationWrapper, draw, maybe_randomize
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, read_about
from jetbot_mjx.training import session

ENVS = 64
EPISODES = 5
EPISODE_LENGTH = 3
WHOLE = {"floor_texture", "clutter", "camera_delay", "camera_interval"}
SMALL = {"distortion": [0.1, 0.1], **{f"camera_{axis}": [0.01, 0.01] for axis in "xyz"}}
NOT_OBSERVED = {"height_offset", "pitch_offset"}  # by an egocentric policy


@pytest.fixture(scope="module")
def config(root):
    return load_config(root / "configs" / "real_jetbot.yaml")


@pytest.fixture(scope="module")
def ranges(config):
    return config.randomization


def test_every_quantity_has_a_range_and_a_parameter():
    names = tuple(RandomizationConfig.model_fields)
    assert names == RobotParams._fields + LookParams._fields
    everything = {name: [1, 1] if name in WHOLE else [0.7, 0.7] for name in LookParams._fields}
    camera = {"task": {"observation": "camera"}, "randomization": everything | SMALL}
    assert tuple(parse_config(camera).randomization.looks) == LookParams._fields


def test_the_preset_draws_all_that_its_policy_can_tell_around_the_presets_robot(ranges):
    assert tuple(ranges.drawn) == tuple(n for n in RobotParams._fields if n not in NOT_OBSERVED)
    for name, (low, high) in ranges.drawn.items():
        assert low < high, name
        if name not in {"dead_band", "motor_lag", "position_noise", "yaw_noise"}:
            assert low <= getattr(RobotParams(), name) <= high, name


def test_draws_fill_their_ranges_evenly_and_by_themselves(ranges):
    keys = jax.random.split(jax.random.PRNGKey(0), 4_000)
    drawn = np.asarray(jax.vmap(lambda key: draw(ranges, key))(keys))
    together = np.corrcoef(drawn.T) - np.eye(len(ranges.drawn))
    assert np.abs(together).max() < 0.08
    for column, (name, (low, high)) in zip(drawn.T, ranges.drawn.items(), strict=True):
        if name in {"action_delay", "observation_delay"}:
            values, counts = np.unique(column, return_counts=True)
            np.testing.assert_array_equal(values, np.arange(low, high + 1))
        else:
            assert column.min() >= np.float32(low)
            assert column.max() <= np.float32(high)
            counts, _ = np.histogram(column, bins=8, range=(low, high))
        np.testing.assert_allclose(counts / len(keys), 1 / len(counts), rtol=0.2, err_msg=name)


@pytest.fixture(scope="module")
def driven(config):
    """Robots through several episodes: what every step left, on the host."""
    batch = wrap_for_training(make_env(config), EPISODE_LENGTH)

    @functools.partial(jax.jit, compiler_options=compiler_options(config.deterministic))
    def drive(keys):
        def step(state, _):
            nstate = batch.step(state, jnp.ones((ENVS, 2)))
            return nstate, nstate

        first = batch.reset(keys)
        return first, jax.lax.scan(step, first, length=EPISODES * EPISODE_LENGTH)[1]

    first, rest = jax.device_get(drive(jax.random.split(jax.random.PRNGKey(3), ENVS)))
    return jax.tree.map(lambda a, b: np.concatenate([a[None], b]), first, rest)


def test_every_quantity_is_another_one_in_every_episode_and_environment(driven, ranges):
    drawn = driven.episode_params.drawn
    assert drawn.shape == (1 + EPISODES * EPISODE_LENGTH, ENVS, len(ranges.drawn))
    within = drawn[:-1].reshape(EPISODES, EPISODE_LENGTH, ENVS, -1)
    assert (within == within[:, :1]).all()
    for name, column in zip(ranges.drawn, np.moveaxis(within[:, 0], -1, 0), strict=True):
        if not name.endswith("_delay"):
            # Of 2^23 numbers, two may be the same.
            assert len(np.unique(column)) > 0.98 * EPISODES * ENVS, name
        low, high = ranges.drawn[name]
        assert np.float32(low) <= column.min() <= column.max() <= np.float32(high)


def test_an_episode_begins_with_motors_at_rest_and_sensors_that_saw_its_start(driven):
    begun = np.flatnonzero(driven.done[:, 0] > 0)
    assert len(begun) == EPISODES
    motors, sensors = driven.episode_params.motors, driven.episode_params.sensors
    np.testing.assert_array_equal(motors.commands[begun], 0.0)
    np.testing.assert_array_equal(motors.targets[begun], 0.0)
    assert np.abs(motors.commands[begun - 1]).max() > 1.0
    starts = driven.pipeline_state.qpos[begun][:, :, :2]
    np.testing.assert_array_equal(sensors.seen[begun][:, :, 0, :2], starts)
    np.testing.assert_array_equal(sensors.seen[begun][:, :, 1, :2], starts)
    assert len(np.unique(sensors.key[begun].reshape(-1, 2), axis=0)) == EPISODES * ENVS


def test_the_first_observation_is_exact_and_the_others_are_not(config):
    env = make_env(config)
    varied = maybe_randomize(env)
    observe = jax.jit(lambda s: env.task.observe(robot_state(s.pipeline_state), s.goal))
    state = jax.jit(varied.reset)(jax.random.PRNGKey(5))
    np.testing.assert_array_equal(state.obs, observe(state))
    with gliding.everywhere():
        state = jax.jit(varied.step)(state, jnp.zeros(2))
    exact = observe(state)
    assert np.abs(state.obs - exact)[:2].max() > 1e-3


def test_an_offset_is_in_the_first_observation_and_not_in_physics(world_env):
    state = world_env.reset(jax.random.PRNGKey(5))
    offset = DomainRandomizationWrapper(
        world_env, RobotParams(height_offset=0.003, pitch_offset=0.02)
    )
    seen = offset.reset(jax.random.PRNGKey(5))
    jax.tree.map(np.testing.assert_array_equal, seen.pipeline_state, state.pipeline_state)
    assert float(seen.obs[2] - state.obs[2]) == pytest.approx(0.003, abs=1e-7)
    assert float(seen.obs[5] - state.obs[5]) == pytest.approx(0.01, abs=1e-4)
    with gliding.everywhere():
        seen = offset.step(seen, jnp.zeros(2))
    height = seen.pipeline_state.qpos[2]
    assert float(seen.obs[2] - height) == pytest.approx(0.003, abs=1e-7)


def test_an_episode_starts_where_and_as_the_robot_was_put(driven, ranges):
    place = [list(ranges.drawn).index(name) for name in ("start_x", "start_y", "start_yaw")]
    x, y, yaw = np.moveaxis(driven.episode_params.drawn[0][:, place], -1, 0)
    qpos = driven.pipeline_state.qpos[0]
    np.testing.assert_allclose(qpos[:, :2], np.stack([x, y], axis=-1), atol=1e-6)
    np.testing.assert_allclose(2 * np.arctan2(qpos[:, 6], qpos[:, 3]), yaw, atol=1e-4)


def test_the_state_keeps_its_tree_and_the_goal_is_that_of_the_plain_environment(config):
    env = make_env(config)
    varied = maybe_randomize(env)
    assert isinstance(varied, DomainRandomizationWrapper)
    key = report_keys(1)[0]
    first = jax.eval_shape(varied.reset, key)
    with gliding.everywhere():
        second = jax.eval_shape(varied.step, first, jnp.zeros(2))
    assert jax.tree.structure(first) == jax.tree.structure(second)
    same = jax.tree.map(lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), first, second)
    assert all(jax.tree.leaves(same))
    goals = (jax.jit(lambda key, one=one: one.reset(key).goal)(key) for one in (varied, env))
    np.testing.assert_array_equal(*goals)


def test_nothing_drawn_is_the_program_of_the_plain_environment():
    env = make_env(parse_config({}))
    assert maybe_randomize(env) is env
    action = jnp.zeros(2)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    assert state.episode_params is None
    other = make_env(parse_config({"randomization": {}}))
    with gliding.everywhere():
        plain, same = (str(jax.make_jaxpr(one.step)(state, action)) for one in (env, other))
    assert plain == same
    # Physics is a function of its model, and of the numbers of it that are traced.
    jax.tree.map(np.testing.assert_array_equal, env.physics.model, other.physics.model)
    assert env.physics._traced_leaves == other.physics._traced_leaves


def test_only_what_is_drawn_enters_the_physics():
    few = make_env(parse_config({"randomization": {"friction": [0.5, 1.0]}}))
    state = jax.eval_shape(maybe_randomize(few).reset, jax.random.PRNGKey(0))
    assert jax.tree.leaves((state.episode_params.motors, state.episode_params.sensors)) == []
    varied = []

    class Seen(JetBotEnv):
        def with_model(self, mjx_model):
            env = super().with_model(mjx_model)
            varied.append(env.physics._traced_leaves)
            return env

    with gliding.everywhere():
        jax.eval_shape(
            DomainRandomizationWrapper(Seen(few.config), ranges=few.config.randomization).step,
            state,
            jnp.zeros(2),
        )
    assert [len(places) for places in varied] == [1]


@pytest.mark.slow
def test_a_training_resumes_to_the_bit_with_everything_drawn(config, tmp_path):
    layers = {f"{name}_hidden_layer_sizes": [8] for name in ("policy", "value")}
    ppo = {"num_envs": 8, "batch_size": 8, "num_minibatches": 1, "unroll_length": 4}
    rest = {"num_timesteps": 128, "network": layers}
    tiny = {
        "checkpoint_interval": 64,
        "robot": {"preset": "real"},
        "task": {"episode_length": 6},
        "randomization": config.randomization.model_dump(mode="json"),
        "ppo": {**ppo, **rest},
        "evaluation": {"episodes": 2},
        "tensorboard": False,
    }
    whole = tmp_path / "whole"
    with gliding.everywhere():
        session.run(parse_config(tiny), whole)
        stopped = shutil.copytree(whole, tmp_path / "stopped")
        shutil.rmtree(checkpoint_path(stopped, 128))
        assert train.main(["--resume", str(stopped)]) == 0
    sums = [read_about(checkpoint_path(run_dir, 128))["sha256"] for run_dir in (whole, stopped)]
    assert sums[0] == sums[1]
    assert sums[0] != read_about(checkpoint_path(stopped, 64))["sha256"]
