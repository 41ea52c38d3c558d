"""The environment's contract: pure, one trace, one shape, the same under jit and vmap."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.command_modules import train
from jetbot_mjx import load_policy
from jetbot_mjx.config import parse_config
from jetbot_mjx.devices import require_device
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.envs.task import layout_size
from jetbot_mjx.errors import UserError

ROOT = Path(__file__).parents[2]
ENVS = 4
STEPS = 20

# So few steps are run that they may take longer, and compiling less.
jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


@functools.cache
def env_and_step(observation):
    env = make_env(parse_config({"task": {"observation": observation}}))
    return env, jit(env.step)


@pytest.fixture(params=["world", "egocentric"])
def env(request):
    return env_and_step(request.param)[0]


@pytest.fixture
def single_step(env):
    return env_and_step(env.config.task.observation)[1]


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.PRNGKey(0), ENVS)


@pytest.fixture(scope="module")
def actions():
    return jax.random.uniform(jax.random.PRNGKey(1), (STEPS, ENVS, 2), minval=-1.0, maxval=1.0)


def same_tree(one, other):
    def shape(x):
        return jnp.shape(x), jnp.asarray(x).dtype, getattr(x, "weak_type", False)

    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert jax.tree.map(shape, one) == jax.tree.map(shape, other)


@pytest.mark.parametrize(
    "env", ["world", pytest.param("egocentric", marks=pytest.mark.slow)], indirect=True
)
def test_vmap_equals_a_loop_over_single_environments(env, single_step, keys, actions):
    batch = jit(jax.vmap(env.reset))(keys)
    step, reset = jit(jax.vmap(env.step)), jit(env.reset)
    singles = [reset(key) for key in keys]
    for t in range(STEPS):
        batch = step(batch, actions[t])
        singles = [single_step(s, a) for s, a in zip(singles, actions[t], strict=True)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *singles)
    assert float(jnp.abs(batch.pipeline_state.qpos[:, :2]).max()) > 0.05  # they moved
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), batch, stacked
    )


def test_step_traces_once(env, keys, actions):
    traces = 0

    def step(state, action):
        nonlocal traces
        traces += 1
        return env.step(state, action)

    compiled = jit(step)
    state = jit(env.reset)(keys[0])
    for t in range(5):
        state = compiled(state, actions[t, 0])
    assert traces == 1


def test_the_state_keeps_its_tree_shapes_and_dtypes(env, single_step, keys):
    state = jit(env.reset)(keys[0])
    same_tree(state, single_step(state, jnp.zeros(2)))


def test_the_same_key_gives_the_same_episode(env, single_step, keys, actions):
    ends = []
    for _ in range(2):
        state = env.reset(keys[0])
        for t in range(STEPS):
            state = single_step(state, actions[t, 0])
        ends.append(state)
    jax.tree.map(np.testing.assert_array_equal, *ends)


def test_different_keys_give_different_goals(env, keys):
    goals = np.asarray(jax.vmap(env.reset)(keys).goal)
    assert len(np.unique(goals, axis=0)) == ENVS


def test_step_leaves_its_input_alone(env, single_step, keys):
    state = env.reset(keys[0])
    before = jax.tree.map(np.array, state)
    names = set(state.metrics), set(state.info)
    single_step(state, jnp.ones(2))
    env.step(state, jnp.ones(2))
    jax.tree.map(np.testing.assert_array_equal, state, before)
    assert (set(state.metrics), set(state.info)) == names


def test_step_merges_what_wrappers_add_to_metrics_and_info(env, single_step, keys):
    state = env.reset(keys[0])
    state = state.replace(
        metrics={**state.metrics, "mine": jnp.float32(1.0)},
        info={**state.info, "also": jnp.float32(2.0)},
    )
    after = single_step(state, jnp.zeros(2))
    assert after.metrics["mine"] == 1.0
    assert after.info["also"] == 2.0


def test_the_observation_is_the_tasks_in_the_layouts_size(env, single_step, keys):
    state = single_step(env.reset(keys[0]), jnp.array([1.0, 0.3]))
    assert state.obs.shape == (env.observation_size,) == (layout_size(env.task.layout),)
    expected = env.task.observe(robot_state(state.pipeline_state), state.goal)
    np.testing.assert_allclose(state.obs, expected, rtol=1e-6)


def test_a_step_lasts_a_sixtieth_of_a_second(env, single_step, keys):
    state = single_step(env.reset(keys[0]), jnp.zeros(2))
    np.testing.assert_allclose(state.pipeline_state.time, 1 / 60, rtol=1e-5)
    assert env.dt == pytest.approx(1 / 60)


def test_the_angular_velocity_is_in_the_world_frame(world_env, keys):
    state = world_env.reset(keys[0])
    roll = jnp.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0], jnp.float32)  # lying on its side
    physics = state.pipeline_state.replace(
        qpos=state.pipeline_state.qpos.at[3:7].set(roll),
        qvel=state.pipeline_state.qvel.at[3:6].set(jnp.array([0.0, 0.0, 2.0])),
    )
    np.testing.assert_allclose(robot_state(physics).angular_velocity_w, (0.0, -2.0, 0.0), atol=1e-6)


def test_actions_beyond_the_limits_are_clipped(env, single_step, keys):
    state = env.reset(keys[0])
    wild = single_step(state, jnp.array([5.0, -9.0]))
    tame = single_step(state, jnp.array([1.0, -1.0]))
    np.testing.assert_array_equal(wild.pipeline_state.qpos, tame.pipeline_state.qpos)


def test_reaching_the_goal_terminates_with_success(env, single_step, keys):
    state = env.reset(keys[0])
    state = state.replace(goal=jnp.array([0.35, 0.0, 0.05]))
    for _ in range(120):
        state = single_step(state, jnp.array([1.0, 0.0]))
        if state.done:
            break
    assert state.done == state.info["terminated"] == state.metrics["success"] == 1.0
    assert state.reward > 0
    assert 0.24 < float(state.pipeline_state.qpos[0]) < 0.29


def test_the_rewards_of_an_episode_add_up_to_the_distance_covered(env, single_step, keys):
    state = env.reset(keys[0])
    start = env.task.distance(robot_state(state.pipeline_state), state.goal)
    total = 0.0
    for _ in range(STEPS):
        state = single_step(state, jnp.array([0.5, 0.2]))
        total += float(state.reward)
        np.testing.assert_allclose(state.metrics["reward/progress"], state.reward)
    end = env.task.distance(robot_state(state.pipeline_state), state.goal)
    np.testing.assert_allclose(total, start - end, atol=1e-5)


def test_with_model_makes_a_new_environment_and_leaves_the_old(env):
    other = env.with_model(env.mjx_model.replace(pair_friction=env.mjx_model.pair_friction * 0.5))
    assert other is not env
    assert float(other.mjx_model.pair_friction.max()) < float(env.mjx_model.pair_friction.max())


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("AsksForAnotherSolver", "MJX does not support mjtSolver.mjSOL_PGS"),
        ("NamesNoSite", "Error: tendon 'rope'"),
    ],
)
def test_a_scene_that_cannot_be_simulated_is_refused_before_a_run_begins(name, reason, tmp_path):
    arguments = ["--config", str(ROOT / "configs" / "smoke.yaml"), "--run-dir", str(tmp_path / "x")]
    with pytest.raises(UserError) as caught:
        train.main([*arguments, "--set", f"task.name=helpers.broken_tasks:{name}"])
    assert f"'helpers.broken_tasks:{name}': its scene cannot be simulated: {reason}" in str(
        caught.value
    )
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_64_bits_are_refused_by_commands_with_the_remedy():
    with jax.enable_x64(True), pytest.raises(UserError, match="JAX_ENABLE_X64 is set: unset it"):
        require_device()


def test_64_bits_are_refused_when_a_policy_is_loaded():
    with jax.enable_x64(True), pytest.raises(UserError, match="JAX_ENABLE_X64 is set: unset it"):
        load_policy("pretrained:jetbot_egocentric")


def test_64_bits_are_refused_with_the_remedy():
    with jax.enable_x64(True), pytest.raises(UserError, match="unset it"):
        make_env(parse_config({}))
