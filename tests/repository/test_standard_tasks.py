"""The standard tasks among the examples: each is Gymnasium's task, and one kernel."""

import importlib.util
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import stats

from helpers.further import slow_unless
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import MissingPackageError
from onekernel import explain, fuse

GYMNASIUM = {
    "reacher": ("Reacher", "Reacher-v5"),
    "hopper": ("Hopper", "Hopper-v5"),
    "half_cheetah": ("HalfCheetah", "HalfCheetah-v5"),
    "walker": ("Walker", "Walker2d-v5"),
}
"""Class of each example with its name in Gymnasium."""

CLASSES = {"cartpole": "Cartpole"} | {name: first for name, (first, _) in GYMNASIUM.items()}
QUICK = ("cartpole",)
INSTANCES, STEPS = 8, 40


@pytest.fixture(scope="module")
def load(root):
    """Return a loader of an example's module."""

    def load(name):
        spec = importlib.util.spec_from_file_location(name, root / "examples" / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="module", params=slow_unless(QUICK.__contains__, CLASSES))
def task(request, load):
    """One task after another: its name, an environment, and its reset and step as kernels."""
    if request.param in GYMNASIUM:
        pytest.importorskip("gymnasium", reason="the models are gymnasium's")
    env = getattr(load(request.param), CLASSES[request.param])()
    kernels = {"reset": fuse(env.reset), "step": fuse(env.step, on_unsupported="raise")}
    return SimpleNamespace(name=request.param, env=env, **kernels)


@pytest.fixture(scope="module")
def walk(task):
    """States and actions of some steps under random actions, with the states after them."""

    @jax.jit
    def run(keys, actions):
        def step(state, action):
            after = jax.vmap(task.step)(state, action)
            return after, (state, after)

        return jax.lax.scan(step, jax.vmap(task.reset)(keys), actions)[1]

    keys = jax.random.split(jax.random.PRNGKey(0), INSTANCES)
    shape = (STEPS, INSTANCES, task.env.action_size)
    actions = jax.random.uniform(jax.random.PRNGKey(1), shape, minval=-1.0)
    before, after = jax.device_get(run(keys, actions))
    return before, np.asarray(actions), after


@pytest.fixture
def original(task, tmp_path, monkeypatch):
    """Gymnasium's environment of a task, whose solver converges."""
    # MuJoCo writes its warnings into a file of the working folder.
    monkeypatch.chdir(tmp_path)
    gymnasium = pytest.importorskip("gymnasium")
    try:
        env = gymnasium.make(GYMNASIUM[task.name][1]).unwrapped
    except gymnasium.error.DependencyNotInstalled as error:
        pytest.skip(f"no gymnasium[mujoco]: {error}")
    options = env.model.opt
    options.iterations, options.ls_iterations, options.tolerance = 1000, 100, 1e-12
    yield env
    env.close()


@pytest.mark.parametrize("task", slow_unless(QUICK.__contains__, GYMNASIUM), indirect=True)
def test_steps_are_those_of_gymnasium(task, walk, original):
    before, actions, after = walk
    assert (task.env.dt, task.env.action_size) == (original.dt, *original.action_space.shape)
    for at in np.ndindex(STEPS, INSTANCES):
        physics = before.pipeline_state
        original.set_state(physics.qpos[at].astype(float), physics.qvel[at].astype(float))
        obs, reward, terminated, _, _ = original.step(actions[at])
        if task.name == "reacher":
            # Gymnasium's fingertip is where the last stage of the integrator saw it.
            np.testing.assert_allclose(after.obs[at], obs, rtol=2e-4, atol=5e-3)
            np.testing.assert_allclose(after.reward[at], reward, rtol=2e-4, atol=5e-3)
            mujoco.mj_forward(original.model, original.data)
            obs, (reward, _) = original._get_obs(), original._get_rew(actions[at])
        np.testing.assert_allclose(after.obs[at], obs, rtol=2e-4, atol=2e-4)
        np.testing.assert_allclose(after.reward[at], reward, rtol=2e-4, atol=2e-4)
        assert after.done[at] == terminated
    # What ends an episode was seen on either side.
    assert {*np.unique(after.done)} == ({0, 1} if task.name in ("hopper", "walker") else {0})


@pytest.mark.parametrize("task", slow_unless(QUICK.__contains__, GYMNASIUM), indirect=True)
def test_rewards_are_the_sums_of_their_terms(task, walk):
    _, _, after = walk
    terms = [x for name, x in after.metrics.items() if name.startswith("reward/")]
    np.testing.assert_allclose(sum(terms), after.reward, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("task", slow_unless(QUICK.__contains__, GYMNASIUM), indirect=True)
def test_episodes_begin_as_those_of_gymnasium(task, original):
    state = jax.vmap(task.reset)(jax.random.split(jax.random.PRNGKey(2), 4096))
    qpos, qvel = np.asarray(state.pipeline_state.qpos), np.asarray(state.pipeline_state.qvel)
    first = [original.reset(seed=seed) and original.state_vector() for seed in range(512)]
    ours, theirs = np.concatenate([qpos, qvel], axis=1), np.stack(first)
    for column in range(ours.shape[1]):
        one, other = ours[:, column], theirs[:, column]
        # The target of reacher does not move.
        is_alike = np.ptp(other) == np.ptp(one) == 0 or stats.ks_2samp(one, other).pvalue > 1e-3
        assert is_alike, column
    obs = np.asarray(state.obs)
    assert obs.shape[1:] == original.observation_space.shape
    assert len(np.unique(obs, axis=0)) == len(obs)


def test_states_keep_their_structure(task):
    first = jax.eval_shape(task.env.reset, jax.random.PRNGKey(0))
    action = jax.ShapeDtypeStruct((task.env.action_size,), jnp.float32)
    after = jax.eval_shape(task.env.step, first, action)
    assert jax.tree.structure(first) == jax.tree.structure(after)
    assert jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), first) == jax.tree.map(
        lambda x: (x.shape, x.dtype, x.weak_type), after
    )


def test_a_step_is_one_kernel(task, capsys):
    key = jax.random.PRNGKey(0)
    state = jax.eval_shape(task.env.reset, key)
    explain(task.reset, key)
    explain(task.step, state, jax.ShapeDtypeStruct((task.env.action_size,), jnp.float32))
    lines = capsys.readouterr().out.splitlines()
    assert [x for x in lines if "kernel" in x] == ["reset is one kernel", "step is one kernel"]


@pytest.mark.parametrize("name", CLASSES)
def test_configurations_are_of_these_tasks(name, root):
    config = load_config(root / "examples" / f"{name}.yaml")
    assert config.environment == f"{name}:{CLASSES[name]}"
    # The fused kernels take both networks alike.
    network = config.ppo.network
    assert network.policy_hidden_layer_sizes == network.value_hidden_layer_sizes
    if name in GYMNASIUM:
        spec = pytest.importorskip("gymnasium").spec(GYMNASIUM[name][1])
        assert config.task.episode_length == spec.max_episode_steps


@pytest.mark.parametrize("name", GYMNASIUM)
def test_without_gymnasium_one_line_names_it(name, load, monkeypatch):
    module = load(name)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    line = f"{name}.py uses a model of gymnasium: pip install gymnasium"
    with pytest.raises(MissingPackageError, match=f"^{line}$"):
        getattr(module, CLASSES[name])()


# Cart-pole.


@pytest.fixture(scope="module")
def cartpole(load):
    """Return the end of an episode of a cart-pole under a function of time and state."""
    env = load("cartpole").Cartpole()
    begin, step = fuse(env.reset), fuse(env.step)

    def run(policy, qpos=None, steps=250):
        def advance(state, _):
            x, angle, speed, rate = *state.pipeline_state.qpos, *state.pipeline_state.qvel
            action = policy(state.pipeline_state.time, x, angle, speed, rate)
            state = step(state, jnp.clip(action, -1.0, 1.0)[None])
            return state, (state.pipeline_state.qpos, state.metrics, state.reward)

        state = begin(jax.random.PRNGKey(0))
        if qpos is not None:
            physics = state.pipeline_state.replace(qpos=jnp.array(qpos), qvel=jnp.zeros(2))
            state = state.replace(pipeline_state=physics)
        return jax.device_get(jax.jit(lambda s: jax.lax.scan(advance, s, length=steps)[1])(state))

    return run


def balance(time, x, angle, speed, rate):
    """A linear controller around the upright pole."""
    return 0.1 * x + 3.0 * jnp.sin(angle) + 0.15 * speed + 0.7 * rate


def test_cartpole_is_a_success_if_the_second_half_is_upright(cartpole):
    qpos, metrics, reward = cartpole(balance, qpos=[0.0, 0.1])
    assert np.abs(qpos[:, 1]).max() < np.deg2rad(12)
    assert metrics["upright"].min() == 1
    assert reward[125:].min() > 0.9
    # Only the last step of an episode tells.
    np.testing.assert_array_equal(np.flatnonzero(metrics["success"]), [249])


@pytest.mark.parametrize(("falls_at", "is_success"), [(4.5, False), (9.0, False), (10.5, True)])
def test_cartpole_is_none_if_the_pole_fell(cartpole, falls_at, is_success):
    def policy(time, *state):
        return jnp.where(time < falls_at, balance(time, *state), 1.0)

    _, metrics, _ = cartpole(policy, qpos=[0.0, 0.1])
    assert metrics["success"][-1] == is_success


def test_cartpole_stays_on_its_rail(cartpole):
    qpos, metrics, _ = cartpole(lambda time, *state: jnp.float32(1.0))
    assert 1.7 < qpos[:, 0].max() < 1.9
    assert metrics["success"].max() == 0


def test_cartpole_hangs_when_an_episode_begins(cartpole):
    qpos, metrics, reward = cartpole(lambda time, *state: jnp.float32(0.0), steps=50)
    assert np.cos(qpos[:, 1]).max() < 0
    assert metrics["upright"].max() == 0
    assert reward.max() < 0.3
