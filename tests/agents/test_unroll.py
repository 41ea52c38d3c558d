"""An unroll as one kernel on CPUs: its numbers are those of single steps, to the bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Wrapper

from helpers.further import slow_unless
from helpers.gliding import Gliding, GlidingPhysics
from jetbot_mjx.agents.fused import launch
from jetbot_mjx.agents.fused.arrays import UNROLL
from jetbot_mjx.agents.fused.shapes import UnrollSpec
from jetbot_mjx.config import load_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.packed import pack
from jetbot_mjx.runs import Setup
from jetbot_mjx.training.ppo_trainer import build_ppo
from onekernel import cpu

pytestmark = pytest.mark.cpu

LENGTH = 12


def built(root, name="jetbot", *overrides, envs=40, env=Gliding):
    """PPO with small networks, on a robot that glides unless told which."""
    sizes = [f"ppo.num_envs={envs}", f"ppo.batch_size={envs}", "ppo.num_minibatches=1"]
    sizes += [f"ppo.unroll_length={LENGTH}", "task.episode_length=7"]
    hidden = [f"ppo.network.{x}_hidden_layer_sizes=[32, 32]" for x in ("policy", "value")]
    settings = load_config(root / "configs" / f"{name}.yaml", [*sizes, *hidden, *overrides])
    return build_ppo(Setup(settings, env=env(settings)))


def collected(ppo, monkeypatch, states, keys, *, at_once):
    """What PPO collects, for each of several policies."""
    monkeypatch.setattr(launch, "has", lambda kernel: at_once or kernel is not UNROLL)
    run = jax.jit(jax.vmap(ppo.collect))
    traced = run.trace(states, keys)
    assert ("ppo_unroll" in str(traced.jaxpr)) == at_once
    assert ("ppo_actions" in str(traced.jaxpr)) != at_once
    return jax.device_get(traced.lower().compile()(states, keys))


def states_of(ppo, policies):
    """Packed states, in which some environments and one policy are about to break."""

    def one(seed):
        state = ppo.init(jax.random.PRNGKey(seed))
        return state.replace(
            normalizer=state.normalizer.replace(
                mean=0.1 * seed + jnp.arange(state.normalizer.mean.size, dtype=jnp.float32)
            )
        )

    states = jax.jit(jax.vmap(one))(jnp.arange(policies))
    env = states.env_state
    qvel = env.pipeline_state.qvel.at[0, 3].set(jnp.nan).at[-1, 0].set(jnp.inf)
    env = env.replace(pipeline_state=env.pipeline_state.replace(qvel=qvel))
    return jax.vmap(ppo.packed)(states.replace(env_state=env))


class RememberingPhysics(GlidingPhysics):
    """Its step has an array, which is in memory."""

    def step(self, state, ctrl, mocap_pos=None):
        rows = jax.lax.scan(lambda c, _: (0.9 * c + ctrl, c), ctrl, length=100)[1]
        last = jax.lax.scan(lambda c, row: (0.9 * c + row, None), ctrl, rows, reverse=True)[0]
        return super().step(state, 0.01 * last, mocap_pos)


class Remembering(Gliding):
    physics_class = RememberingPhysics


CASES = {
    "jetbot": ("jetbot", 40, 1, (), make_env),
    "egocentric": ("jetbot_egocentric", 17, 3, (), make_env),
    "smoke": ("smoke", 33, 1, (), make_env),
    "drawn robots": ("real_jetbot", 21, 2, (), make_env),
    # These are about the kernel's parts and the networks, not about how a robot moves.
    "arrays": ("jetbot", 37, 2, (), Remembering),
    "one environment": ("jetbot", 1, 1, (), Gliding),
    "more than a part": ("jetbot", 67, 2, (), Gliding),
    "parts of odd sizes": ("jetbot", 2113, 1, (), Gliding),
    "several unrolls": ("jetbot", 16, 2, ("ppo.num_minibatches=3",), Gliding),
    "normal": ("jetbot", 24, 2, ("ppo.network.distribution_type=normal",), Gliding),
    "not normalised": ("jetbot", 24, 1, ("ppo.normalize_observations=false",), Gliding),
}


# The quick ones are two policies of drawn robots, and a single environment.
FURTHER = (
    "jetbot",
    "egocentric",
    "smoke",
    "more than a part",
    "parts of odd sizes",
    "not normalised",
    "several unrolls",
    "normal",
)


@pytest.mark.parametrize("case", slow_unless(lambda case: case not in FURTHER, CASES))
def test_an_unroll_is_its_steps_one_by_one(root, monkeypatch, case):
    name, envs, policies, overrides, env = CASES[case]
    ppo = built(root, name, *overrides, envs=envs, env=env)
    states = states_of(ppo, policies)
    keys = jax.vmap(jax.random.PRNGKey)(jnp.arange(policies) + 5)
    ours, theirs = (
        collected(ppo, monkeypatch, states, keys, at_once=at_once) for at_once in (True, False)
    )
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)
    # Episodes end in every way, and every policy drives differently.
    _, data, dump = ours
    ended = data.extras["state_extras"]["episode_done"]
    assert ended.any()
    assert np.isfinite(data.observation).all()
    if envs > 4:
        assert dump.found[0]
    assert len(np.unique(data.action[:, 0, 0, 0])) == policies


def test_where_a_step_is_no_kernel_actions_and_steps_take_turns(root):
    ppo = built(root)
    state = jax.eval_shape(lambda: ppo.packed(ppo.init(jax.random.PRNGKey(0))))
    assert ppo._env.step_packed.kernel(state.env_state) is not None
    with jax.disable_jit():
        assert ppo._env.step_packed.kernel(state.env_state) is None
    many = built(root, "jetbot", "physics.impl=xla")
    assert many.learner.name == "fused"
    assert many._env.step_packed.kernel(state.env_state) is None
    assert "ppo_actions" in str(jax.make_jaxpr(many.collect)(state, jax.random.PRNGKey(0)))


def test_an_observation_of_other_numbers_is_not_read_as_floats(root, monkeypatch):
    ppo = built(root)
    state = jax.eval_shape(lambda: ppo.packed(ppo.init(jax.random.PRNGKey(0))))
    assert ppo.learner.unroll_spec(ppo._env, state.env_state) is not None
    env = ppo._env.env.env
    step = env.step

    def in_whole_numbers(state):
        return state.replace(obs=state.obs.astype(jnp.int32))

    monkeypatch.setattr(env, "step", lambda *given: in_whole_numbers(step(*given)))
    ppo._env.env.__init__(env)
    packed = jax.eval_shape(
        lambda x: pack(in_whole_numbers(x.unpack()), batch_axes=1), state.env_state
    )
    assert ppo._env.step_packed.kernel(packed) is not None
    assert ppo.learner.unroll_spec(ppo._env, packed) is None


@pytest.mark.parametrize("change", ["dtype", "size"])
def test_a_state_that_a_step_lays_out_differently_is_refused(root, monkeypatch, change):
    """The kernel would read other numbers, or write beyond the end of its arrays."""
    ppo = built(root)
    env = ppo._env.env.env
    step = env.step

    def changed(state, action):
        state = step(state, action)
        goal = state.goal.view(jnp.int32) if change == "dtype" else jnp.tile(state.goal, 100)
        return state.replace(goal=goal)

    monkeypatch.setattr(env, "step", changed)
    ppo._env.env.__init__(env)
    state = jax.eval_shape(lambda: ppo.packed(ppo.init(jax.random.PRNGKey(0))))
    assert ppo._env.step_packed.kernel(state.env_state) is None
    with pytest.raises(TypeError, match="carry"):
        jax.eval_shape(ppo.collect, state, jax.random.PRNGKey(0))


def test_a_wrapper_with_a_step_of_its_own_is_stepped(root, monkeypatch):
    ppo = built(root)
    state = jax.eval_shape(lambda: ppo.packed(ppo.init(jax.random.PRNGKey(0))))

    class Backwards(Wrapper):
        def step_packed(self, packed, action):
            return self.env.step_packed(packed, -action)

    monkeypatch.setattr(ppo, "_env", Backwards(ppo._env))
    text = str(jax.make_jaxpr(ppo.collect)(state, jax.random.PRNGKey(0)))
    assert "ppo_actions" in text
    assert "ppo_unroll" not in text


def test_asking_for_the_kernel_compiles_nothing(root, monkeypatch):
    begun = []
    monkeypatch.setattr(cpu, "prepare", begun.append)
    ppo = built(root)
    state = jax.eval_shape(lambda: ppo.packed(ppo.init(jax.random.PRNGKey(0))))
    before = len(begun)
    assert ppo._env.step_packed.kernel(state.env_state) is not None
    assert len(begun) == before


@pytest.mark.parametrize("wrong", range(5))
def test_an_unroll_of_other_shapes_is_refused(root, wrong):
    ppo = built(root)
    state = jax.eval_shape(lambda: ppo.packed(ppo.init(jax.random.PRNGKey(0))))
    shape, words = ppo.learner.shape, state.env_state.words.shape
    spec = UnrollSpec(shape, ppo._env.step_packed.kernel(state.env_state), 0, (3, 4, 1))
    sizes = [(shape.size,), (16,), (16,), words, (LENGTH, words[0], 2)]
    arrays = [jax.ShapeDtypeStruct(size, np.float32) for size in sizes]
    jax.eval_shape(lambda *x: launch.unroll(spec, *x), *arrays)
    for size, dtype in (
        ((*sizes[wrong][:-1], sizes[wrong][-1] - 1), np.float32),
        ((1, *sizes[wrong]), np.float32),
        (sizes[wrong], np.int32),
    ):
        arrays[wrong] = jax.ShapeDtypeStruct(size, dtype)
        with pytest.raises((TypeError, ValueError)):
            jax.eval_shape(lambda *x: launch.unroll(spec, *x), *arrays)
