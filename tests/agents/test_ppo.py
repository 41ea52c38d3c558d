"""The training step: stock Brax's, number by number, and what it does with NaN."""

import contextlib
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax.training.agents.ppo import losses

from helpers import gliding
from helpers.command_modules import evaluate, replay
from helpers.gliding import Gliding, GlidingPhysics
from helpers.small_ppo import (
    SIZE,
    TINY,
    beginning,
    furthest,
    lines,
    made_up,
    with_ppo,
)
from jetbot_mjx.agents import loss
from jetbot_mjx.agents.ppo import PPO
from jetbot_mjx.agents.train_state import LOSSES
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.task import EGOCENTRIC, LAYOUTS, Field, GoalTask
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.checkpoint_store import flatten
from jetbot_mjx.runs.nan_dump import load_nan_dump
from jetbot_mjx.training import brax_trainer, ppo_trainer, session
from jetbot_mjx.training.ppo_trainer import build_ppo
from jetbot_mjx.training.run_recorder import RunRecorder

STEPS = 4


@pytest.fixture(scope="module")
def smoke(root):
    # With XLA's update on a GPU too, which can be compared with Brax number by number.
    return load_config(root / "configs" / "smoke.yaml", ["ppo.update=xla"])


@contextlib.contextmanager
def full_precision():
    """No TF32 on a GPU, in all threads: a training compiles in one of its own."""
    name = "jax_default_matmul_precision"
    before = jax.config.values[name]
    jax.config.update(name, "highest")
    try:
        yield
    finally:
        jax.config.update(name, before)


@pytest.fixture
def glide():
    """What a training builds glides, in full precision."""
    with gliding.everywhere(), full_precision():
        yield


def on_one_device(config, env):
    """`PPO` that needs no mesh of devices."""
    networks = build_ppo(Setup(config, env=env)).networks
    return PPO(config.ppo, wrap_for_training(env, config.task.episode_length), networks)


class Jitted:
    """`PPO` on one device, compiled once for every number of training steps.

    In full precision, as a CPU has it anyway: a GPU's TF32 tells 1 from 1.001 and no less.
    """

    def __init__(self, config, env):
        self.ppo = on_one_device(config, env)
        self.init = jax.jit(self.ppo.init)
        self._jitted = jax.jit(self._advance)

    def _advance(self, state, steps, restart):
        state, nan_dump = self.ppo.advance(self.ppo.packed(state), steps, restart)
        return self.ppo.unpacked(state), nan_dump

    def advance(self, state, steps=1, restart=False):
        after, nan_dump = self._compiled(state, jnp.int32(steps), jnp.bool_(restart))
        return after, nan_dump.replace(env_state=jax.device_get(nan_dump.env_state).unpack())

    @functools.cached_property
    def _compiled(self):
        shapes = jax.eval_shape(self.ppo.init, jax.random.PRNGKey(0))
        with jax.default_matmul_precision("highest"):
            return self._jitted.lower(shapes, jnp.int32(0), jnp.bool_(False)).compile()


def assert_same_bits(one, other):
    one, other = flatten(one), flatten(other)
    assert one.keys() == other.keys()
    for name, leaf in one.items():
        np.testing.assert_array_equal(leaf, other[name], err_msg=name)


# Stock Brax and this package's step, side by side.


class Reports:
    """Keeps what a trainer reports."""

    def __init__(self):
        self.all = []

    def on_interval(self, progress):
        self.all.append(progress[0])
        return True


def epoch_keys(seed):
    """The keys with which Brax's train() begins its epochs, one after the other."""
    _, local = jax.random.split(jax.random.PRNGKey(seed))
    local = jax.random.split(jax.random.fold_in(local, 0), 3)[0]
    while True:
        epoch, local = jax.random.split(local)
        yield jax.random.split(epoch, 1)[0]


# ("NONE", 1.0) has a whole epoch below.
VARIANTS = [
    (Gliding, "ADAPTIVE_KL", None),
    pytest.param((Gliding, "NONE", None), marks=pytest.mark.slow),
    # With the real robot, which takes long to compile.
    pytest.param((JetBotEnv, "ADAPTIVE_KL", 1.0), marks=pytest.mark.slow),
]


@pytest.fixture(scope="module")
def ours(smoke):
    """A function from a variant to its environment and its compiled step."""

    @functools.cache
    def make(env_type, schedule, max_grad_norm):
        # A KL so small that the schedule has something to do at every update.
        changes = {"learning_rate_schedule": schedule, "max_grad_norm": max_grad_norm}
        env = env_type(smoke)
        config = with_ppo(smoke, **changes, desired_kl=0.003, normalizer="brax")
        return env, Jitted(config, env)

    return make


def name_variant(variant):
    env_type, schedule, max_grad_norm = variant
    return f"{env_type.__name__}-{schedule}-{max_grad_norm}"


@pytest.fixture(scope="module", params=VARIANTS, ids=name_variant)
def side_by_side(request, smoke, ours):
    """The schedule, and (Brax's report, our state) after each training step, Brax's epochs."""
    env, one = ours(*request.param)
    ppo = one.ppo.config.model_copy(update={"num_timesteps": STEPS * SIZE})
    reports = Reports()
    config = smoke.model_copy(update={"checkpoint_interval": SIZE, "ppo": ppo})
    with jax.default_matmul_precision("highest"):
        brax_trainer.train(Setup(config, env=env), reports)
    state, keys = one.init(jax.random.PRNGKey(smoke.seed)), epoch_keys(smoke.seed)
    states = [state]
    for _ in range(STEPS):
        states.append(one.advance(states[-1].replace(key=next(keys)), restart=True)[0])
    return request.param[1], list(zip(reports.all, jax.device_get(states), strict=True))


def test_training_begins_where_brax_begins(side_by_side):
    _, [(brax, state), *_] = side_by_side
    ours, theirs = flatten(state.policy_params), flatten(brax.params)
    assert ours.keys() == theirs.keys()
    # The initialiser's scale is a square root. Brax, operation by operation, has the device take
    # it; in one program XLA takes it on the host. A CPU's is the same.
    rtol = 0 if jax.default_backend() == "cpu" else 2**-22
    for name, leaf in ours.items():
        np.testing.assert_allclose(leaf, theirs[name], rtol=rtol, atol=0, err_msg=name)


def test_one_training_step_is_brax_s(side_by_side, smoke):
    schedule, [_, (brax, state), *_] = side_by_side
    # The 16 updates move a parameter by up to 16e-3. Where the two programs round differently
    # in the last of float32's 24 bits, Adam, which divides a gradient by its own size, carries
    # that to 2e-7 here; other processors may add up in another order.
    assert furthest(state.params.policy, brax.params.policy) < 5e-6
    assert furthest(state.params.value, brax.params.value) < 5e-6
    # Sums over 4096 observations of up to 1.2 m and 6 rad/s.
    assert_close(state.normalizer, brax.params.normalizer, rtol=2e-6)
    assert int(brax.env_steps) == ppo_trainer.env_steps(state) == SIZE
    updates = smoke.ppo.updates_per_training_step
    metrics = {name: float(state.sums[name]) / updates for name in LOSSES.values()}
    expected = {name: brax.metrics[name] for name in LOSSES.values()}
    # Means of 16 minibatches of 1024 samples; they agree to 1e-7 here.
    assert metrics == pytest.approx(expected, rel=1e-5, abs=1e-6)
    adaptive = metrics["policy/learning_rate"] < 0.9 * smoke.ppo.learning_rate
    assert adaptive == (schedule == "ADAPTIVE_KL")
    assert state.sums["nonfinite_updates"] == state.sums["nonfinite_envs"] == 0


def assert_close(one, other, rtol):
    for (name, a), b in zip(flatten(one).items(), flatten(other).values(), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=1e-7, err_msg=name)


def test_several_training_steps_are_brax_s(side_by_side, smoke):
    # Found: 5e-7. Driving is chaotic, and a comparison that flips in the clipped loss, in the KL
    # rule or at the goal's rim moves a whole sample: a tenth of the way travelled is the bound.
    _, [(_, begun), _, *later] = side_by_side
    for brax, state in later:
        travelled = furthest(state.params, begun.params)
        assert travelled > 5e-3
        assert furthest(state.policy_params[1:], brax.params[1:]) < 0.1 * travelled
        total = float(state.sums["loss/total"]) / smoke.ppo.updates_per_training_step
        assert total == pytest.approx(brax.metrics["loss/total"], rel=0.02, abs=1e-3)


@pytest.mark.slow
def test_the_keys_go_on_as_within_an_epoch_of_brax(smoke, ours):
    env, one = ours(Gliding, "NONE", 1.0)
    ppo = one.ppo.config.model_copy(update={"num_timesteps": STEPS * SIZE})
    reports = Reports()
    config = smoke.model_copy(update={"checkpoint_interval": STEPS * SIZE, "ppo": ppo})
    with jax.default_matmul_precision("highest"):
        brax_trainer.train(Setup(config, env=env), reports)
    state, _ = one.advance(one.init(jax.random.PRNGKey(smoke.seed)), STEPS)
    assert furthest(state.policy_params[1:], reports.all[-1].params[1:]) < 5e-3
    assert int(jax.device_get(state.normalizer.count).to_numpy()) == STEPS * SIZE


# The floor under the normaliser's deviations.


@pytest.fixture(scope="module")
def normalized(smoke):
    """A function from the normaliser to the environment and the states after 0, 1, 2 steps."""
    world = smoke.model_copy(update={"task": parse_config({}).task})

    @functools.cache
    def make(normalizer):
        config = with_ppo(world, normalizer=normalizer)
        env = Gliding(config)
        one = Jitted(config, env)
        states = [one.init(jax.random.PRNGKey(0))]
        for _ in range(2):
            states.append(one.advance(states[-1])[0])
        return env, [state.normalizer for state in jax.device_get(states)]

    return make


@pytest.mark.slow
def test_no_deviation_is_below_its_physical_scale(normalized):
    env, statistics = normalized("physical")
    floor = env.observation_min_std
    expected = [*[0.01] * 3, *[0.05] * 4, *[0.05] * 3, *[0.1] * 3, *[0.01] * 3]
    np.testing.assert_array_equal(floor, np.float32(expected))
    seen = statistics[-1]
    assert np.all(seen.std >= floor)
    # A gliding robot stays on its floor: z, tilt, vertical speed and two of the rates are steady.
    steady = np.flatnonzero(seen.summed_variance / (2 * SIZE) < (0.1 * floor) ** 2)
    assert steady.tolist() == [2, 4, 5, 9, 10, 11, 15]
    np.testing.assert_array_equal(seen.std[steady], floor[steady])


@pytest.mark.slow
def test_the_floor_changes_nothing_but_the_deviations(normalized):
    env, (_, ours, later) = normalized("physical")
    _, (_, stock, stock_later) = normalized("brax")
    # Before the first update both see the same.
    np.testing.assert_allclose(ours.mean, stock.mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(ours.summed_variance, stock.summed_variance, rtol=1e-5, atol=1e-6)
    floored = np.maximum(stock.std, env.observation_min_std)
    np.testing.assert_allclose(ours.std, floored, rtol=1e-5)
    assert np.min(stock_later.std) == np.float32(1e-6)
    wide = later.std > 2 * env.observation_min_std
    variance = later.summed_variance / (2 * SIZE)
    np.testing.assert_allclose(later.std[wide] ** 2, variance[wide], rtol=1e-5)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [({}, 5.0), ({"normalizer": "brax"}, 1.0), ({"normalize_observations": False}, 1.0)],
)
def test_a_field_states_its_own_scale(smoke, settings, expected):
    config = with_ppo(smoke, num_envs=2, batch_size=2, **settings)
    env = Gliding(config)
    env.task.layout = (*env.task.layout[:-1], Field("yaw_rate", 1, "deg/s", "body", min_std=5.0))
    ppo = on_one_device(config, env)
    std = jax.jit(ppo.init)(jax.random.PRNGKey(0)).normalizer.std
    np.testing.assert_array_equal(std, [1.0] * 6 + [expected])


def test_a_unit_without_a_scale_is_refused_before_anything_is_written(smoke, monkeypatch, tmp_path):
    layout = (*EGOCENTRIC[:-1], Field("yaw_rate", 1, "deg/s", "body"))
    monkeypatch.setitem(LAYOUTS, "egocentric", layout)
    said = "'yaw_rate' has the unit 'deg/s', for which no smallest deviation is known"
    with pytest.raises(UserError, match=said):
        session.run(smoke, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []
    config = with_ppo(smoke, normalizer="brax")
    on_one_device(config, Gliding(config))


# Gradients that are not finite.


@functools.cache
def tiny(schedule="NONE", passes=1):
    values = TINY | {"learning_rate_schedule": schedule, "num_updates_per_batch": passes}
    config = parse_config({"task": {"observation": "egocentric"}, "ppo": values})
    jitted = Jitted(config, make_env(config))
    compiled = jax.jit(jitted.ppo.learner.update)

    def update(*arguments):
        params, optimizer_state, totals = compiled(*arguments)
        names = [*LOSSES.values(), "applied"]
        return params, optimizer_state, dict(zip(names, totals, strict=True))

    return jitted.ppo, update


def by_hand(ppo, params, normalizer, data, key):
    """One pass, written out: plain Adam, and minibatches with a bad reward left out."""
    config = ppo.config
    adam = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(1e-3))
    moments = adam.init(params)
    _, shuffle_key, key = jax.random.split(key, 3)
    order = jax.random.permutation(shuffle_key, config.batch_size * config.num_minibatches)
    brax_loss = functools.partial(
        losses.compute_ppo_loss,
        ppo_network=ppo.networks,
        entropy_cost=config.entropy_cost,
        discounting=config.discounting,
        reward_scaling=config.reward_scaling,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clipping_epsilon,
        vf_coefficient=config.vf_loss_coefficient,
    )

    @jax.jit
    def descend(params, moments, batch, key):
        gradient, metrics = jax.grad(brax_loss, has_aux=True)(params, normalizer, batch, key)
        change, moments = adam.update(gradient, moments)
        return optax.apply_updates(params, change), moments, metrics

    seen, skipped = [], 0
    for chosen in order.reshape(config.num_minibatches, -1):
        key, loss_key = jax.random.split(key)
        batch = jax.tree.map(lambda x, chosen=chosen: x[chosen], data)
        if np.isnan(batch.reward).any():
            skipped += 1
            continue
        params, moments, metrics = descend(params, moments, batch, loss_key)
        seen.append(metrics)
    return params, moments, seen, skipped


def test_a_gradient_that_is_not_finite_skips_its_own_step_alone():
    ppo, update = tiny()
    params, optimizer_state, normalizer = beginning(ppo)
    data, key = made_up(ppo, spoiled=[13]), jax.random.PRNGKey(5)
    after, state_after, totals = update(params, optimizer_state, normalizer, data, key)
    expected, moments, seen, skipped = by_hand(ppo, params, normalizer, data, key)
    assert skipped == 1
    assert float(totals["applied"]) == 3
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((after, state_after)))
    assert furthest(params, after) > 1e-3
    assert furthest(expected, after) < 2e-6
    ours = state_after[-1].inner_state[0]
    assert int(ours.count) == len(seen) == 3
    assert_close(ours.mu, moments[1][0].mu, rtol=1e-4)
    assert_close(ours.nu, moments[1][0].nu, rtol=1e-4)
    for theirs, name in LOSSES.items():
        if theirs in seen[0]:
            total = np.sum([one[theirs] for one in seen])
            np.testing.assert_allclose(totals[name], total, rtol=1e-4, err_msg=name)
    assert float(totals["policy/learning_rate"]) == pytest.approx(3e-3)


def test_a_bad_unroll_costs_one_update_in_every_pass():
    ppo, update = tiny("ADAPTIVE_KL", passes=3)
    params, optimizer_state, normalizer = beginning(ppo)
    data = made_up(ppo, spoiled=[0])
    *_, totals = update(params, optimizer_state, normalizer, data, jax.random.PRNGKey(5))
    assert float(totals["applied"]) == 9
    *_, totals = update(params, optimizer_state, normalizer, made_up(ppo), jax.random.PRNGKey(5))
    assert float(totals["applied"]) == 12


def test_where_every_gradient_is_bad_nothing_moves_by_a_bit():
    # Under ADAPTIVE_KL the step size would move, too: it belongs to the optimizer's state.
    ppo, update = tiny("ADAPTIVE_KL", passes=3)
    params, optimizer_state, normalizer = beginning(ppo)
    data = made_up(ppo, spoiled=range(32))
    after, state_after, totals = update(
        params, optimizer_state, normalizer, data, jax.random.PRNGKey(5)
    )
    assert_same_bits((after, state_after), (params, optimizer_state))
    assert set(map(float, totals.values())) == {0.0}


# Non-finite states, a falling step size, and sums over several calls.

FUSE = 5  # environment steps that a brittle world lasts; too few to reach a goal


class BrittlePhysics(GlidingPhysics):
    def step(self, state, ctrl, mocap_pos=None):
        after = super().step(state, ctrl, mocap_pos)
        spent = after.time > (FUSE - 0.5) * self._config.ctrl_dt
        return after.replace(qvel=jnp.where(spent, jnp.nan, after.qvel))


class Brittle(Gliding):
    physics_class = BrittlePhysics


LINEAR_STEPS = 8


@pytest.fixture(scope="module")
def brittle(smoke):
    changes = {"learning_rate_schedule": "LINEAR", "num_timesteps": LINEAR_STEPS * SIZE}
    config = with_ppo(smoke, **changes)
    return Jitted(config, Brittle(config))


@pytest.fixture(scope="module")
def begun(brittle):
    return brittle.init(jax.random.PRNGKey(3))


@pytest.fixture(scope="module")
def at_once(brittle, begun):
    """The state after all steps, made in one call, and the first nan_dump."""
    return brittle.advance(begun, LINEAR_STEPS)


def test_worlds_that_blow_up_are_counted_and_do_not_spoil_the_state(brittle, begun, at_once):
    state, _ = brittle.advance(begun)
    ppo = brittle.ppo.config
    steps = ppo.steps_per_training_step // ppo.num_envs
    assert float(state.sums["nonfinite_envs"]) == ppo.num_envs * (steps // FUSE)
    assert float(state.sums["rollout/episodes"]) == ppo.num_envs * (steps // FUSE)
    state, _ = at_once
    assert float(state.sums["nonfinite_envs"]) == ppo.num_envs * (LINEAR_STEPS * steps // FUSE)
    assert float(state.sums["nonfinite_updates"]) == 0
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(state))


def replayed(env, config, nan_dump):
    """1 for each step that blew up, from a nan_dump's beginning, in a batch of one."""
    wrapped = wrap_for_training(env, config.task.episode_length)
    step = jax.jit(wrapped.step)
    state = jax.tree.map(lambda x: jnp.asarray(x)[None], nan_dump.env_state)
    found = []
    for action in nan_dump.actions:
        state = step(state, action[None])
        found.append(float(state.metrics["nonfinite_envs"][0]))
    return found


def test_the_first_fault_leads_to_the_same_end(brittle, begun, at_once, smoke):
    _, nan_dump = at_once
    assert bool(nan_dump.found)
    assert int(nan_dump.step) == FUSE - 1
    first_world = jax.tree.map(lambda x: x[0], begun.env_state)
    assert_same_bits(nan_dump.env_state, first_world)
    unroll = smoke.ppo.unroll_length
    blown = [float((index + 1) % FUSE == 0) for index in range(unroll)]
    assert replayed(Brittle(smoke), smoke, nan_dump) == blown


def test_where_nothing_blew_up_there_is_no_fault(ours, smoke):
    _, one = ours(Gliding, "NONE", 1.0)
    _, nan_dump = one.advance(one.init(jax.random.PRNGKey(smoke.seed)), 2)
    assert not bool(nan_dump.found)


class Unborn(Gliding):
    """A world of which one in fifty begins with an observation that is not finite."""

    def reset(self, rng):
        state = super().reset(rng)
        bad = jax.random.bernoulli(jax.random.fold_in(rng, 1), 1 / 50)
        return state.replace(obs=jnp.where(bad, jnp.nan, state.obs))


def test_a_first_observation_that_is_not_finite_does_not_reach_what_is_learned(smoke):
    one = Jitted(smoke, Unborn(smoke))
    begun = one.init(jax.random.PRNGKey(0))
    state, nan_dump = one.advance(begun)
    assert float(state.sums["nonfinite_envs"]) >= 1
    assert float(state.sums["nonfinite_updates"]) == 0
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((state.params, state.normalizer)))
    assert furthest(state.params, begun.params) > 1e-3
    assert replayed(Unborn(smoke), smoke, nan_dump).index(1.0) == int(nan_dump.step)


def test_the_linear_step_size_falls_to_nothing(brittle, begun, smoke):
    ppo = brittle.ppo.config
    per_step = ppo.num_minibatches * ppo.num_updates_per_batch
    state, rates = begun, []
    for _ in range(LINEAR_STEPS + 1):
        before = state
        state, _ = brittle.advance(state, restart=True)
        rates.append(float(state.sums["policy/learning_rate"]) / per_step)
    middle = np.arange(LINEAR_STEPS) * per_step + (per_step - 1) / 2
    fallen = smoke.ppo.learning_rate * (1 - middle / (LINEAR_STEPS * per_step))
    np.testing.assert_allclose(rates[:-1], fallen, rtol=1e-5)
    # Beyond the end nothing is learnt.
    assert rates[-1] == 0
    assert_same_bits(state.params, before.params)


def test_how_steps_are_cut_into_calls_does_not_matter(brittle, begun, at_once):
    state = begun
    for steps in (1, 3, 4):
        state, _ = brittle.advance(state, steps)
    assert_same_bits(state, at_once[0])
    assert float(state.sums["training_steps"]) == LINEAR_STEPS


def test_a_restart_empties_the_tally_and_nothing_else(brittle, begun):
    earlier, _ = brittle.advance(begun, 2)
    added, _ = brittle.advance(earlier, 1)
    restarted, _ = brittle.advance(earlier, 1, restart=True)
    assert_same_bits(restarted.replace(tally=0), added.replace(tally=0))
    assert float(restarted.sums["training_steps"]) == 1
    for name, value in restarted.sums.items():
        total = float(earlier.sums[name]) + float(value)
        assert float(added.sums[name]) == pytest.approx(total, rel=1e-6), name
    no_steps, nan_dump = brittle.advance(earlier, 0, restart=True)
    assert not bool(nan_dump.found)
    assert set(map(float, no_steps.sums.values())) == {0.0}


# Whole trainings.

DOOMED = 1 / 250
BAD_UPDATES = 1 / 50


class Doomed(GoalTask):
    """The goal task; the reward of some goals is NaN once the robot has left the start."""

    def reward(self, before, after, goal, action):
        reward, terms = super().reward(before, after, goal, action)
        # The goal's own digits decide, so that a replay decides the same.
        doomed = jnp.mod(jnp.abs(goal[0]) * 1e3, 1.0) < DOOMED
        off = jnp.linalg.norm(after.position_w[:2]) > 0.05
        return jnp.where(doomed & off, jnp.nan, reward), terms


@pytest.mark.slow
def test_training_bears_blown_worlds_and_bad_gradients(smoke, glide, tmp_path, monkeypatch, capsys):
    config = with_ppo(smoke, num_timesteps=131_072, checkpoint_interval=32_768)
    sound = loss.ppo_loss

    def now_and_then(params, normalizer, data, key, **settings):
        value, metrics = sound(params, normalizer, data, key, **settings)
        bad = jax.random.bernoulli(jax.random.fold_in(key, 1), BAD_UPDATES)
        return value * jnp.where(bad, jnp.nan, 1.0), metrics

    monkeypatch.setattr(loss, "ppo_loss", now_and_then)
    task = smoke.task.model_copy(update={"name": f"{__name__}:Doomed"})
    spoiled = session.run(config.model_copy(update={"task": task}), tmp_path / "spoiled")

    history = lines(tmp_path / "spoiled")
    worlds = sum(line.get("train/nonfinite_envs", 0) for line in history)
    updates = sum(line.get("train/nonfinite_updates", 0) for line in history)
    episodes = sum(line.get("rollout/episodes", 0) for line in history)
    assert episodes > 500
    assert 0.001 < worlds / episodes < 0.02
    assert 2 <= updates <= 30  # of 512
    assert spoiled.best.success_rate > 0.85  # sound, it is above 0.95

    files = sorted((tmp_path / "spoiled" / "nan_dumps").glob("*.npz"))
    assert 1 <= len(files) <= worlds
    stored = load_nan_dump(files[0])
    assert stored.config.task.name == task.name
    found = replayed(Gliding(stored.config), stored.config, stored.nan_dump)
    assert found.index(1.0) == int(stored.nan_dump.step)
    capsys.readouterr()
    assert replay.main([str(files[0])]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.split()[0] == str(int(stored.nan_dump.step))
    assert last.endswith("reward")


@pytest.mark.slow
def test_a_training_compiles_its_step_once_and_nothing_later(smoke, glide, tmp_path, monkeypatch):
    compiled, after_report = [], []

    def listen(event, duration, *, fun_name="", **rest):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(fun_name)

    report = RunRecorder.on_interval

    def noting(self, progress):
        going_on = report(self, progress)
        after_report.append(len(compiled))
        return going_on

    monkeypatch.setattr(RunRecorder, "on_interval", noting)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        config = with_ppo(smoke, num_timesteps=6 * SIZE, checkpoint_interval=2 * SIZE)
        session.run(config, tmp_path / "run")
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert len(after_report) == 4
    assert sum("advance" in name for name in compiled) == 1
    for name in ("train/nonfinite_envs", "train/nonfinite_updates"):
        assert [line[name] for line in lines(tmp_path / "run")[1:]] == [0, 0, 0]
    # Report 0 is made before the first call; with report 1 all has run once.
    assert after_report[1] == after_report[-1] == len(compiled), compiled[after_report[1] :]


SEEDS = 3


@pytest.fixture(scope="module")
def several(smoke, tmp_path_factory):
    """Three seeds from 5 on, trained at once over two checkpoints, and their result."""
    config = with_ppo(smoke, num_timesteps=2 * SIZE, checkpoint_interval=SIZE, seed=5, seeds=SEEDS)
    with gliding.everywhere(), full_precision():
        return config, session.run(config, tmp_path_factory.mktemp("seeds") / "run")


@pytest.mark.slow
def test_each_of_several_seeds_is_trained_as_if_alone(several, ours):
    config, result = several
    _, one = ours(Gliding, "NONE", 1.0)
    for seed in range(config.seed, config.seed + SEEDS):
        state, _ = one.advance(one.init(jax.random.PRNGKey(seed)), 2)
        stored = load_checkpoint(result.run_dir / f"seed-{seed}", "last").params
        # Batched over the seeds, sums round differently; after two steps chaos has multiplied
        # that. Two seeds' parameters differ by about 1.
        assert furthest(state.policy_params[1:], stored[1:]) < 1e-3


@pytest.mark.slow
def test_each_of_several_seeds_has_a_run_of_its_own(several, glide, blank_figures, capsys):
    config, result = several
    folders = sorted(path.name for path in result.run_dir.glob("seed-*"))
    assert folders == ["seed-5", "seed-6", "seed-7"]
    assert len(set(result.fingerprints)) == SEEDS
    for seed, name in enumerate(folders, start=5):
        run_dir = result.run_dir / name
        alone = config.model_copy(update={"seed": seed, "seeds": 1})
        assert load_config(run_dir / "config.yaml") == alone
        assert [line["env_steps"] for line in lines(run_dir)] == [0, SIZE, 2 * SIZE]
        assert len(list((run_dir / "checkpoints").iterdir())) == 3
        assert load_checkpoint(run_dir, "last").config == alone
    assert evaluate.main([str(result.run_dir / "seed-6"), "--episodes", "48"]) == 0
    assert "policy" in capsys.readouterr().out


@pytest.mark.slow
def test_several_seeds_resume_to_the_bit(several, glide, tmp_path, capsys):
    config, result = several
    session.run(with_ppo(config, num_timesteps=SIZE), tmp_path / "run")
    capsys.readouterr()
    resumed = session.run(config, tmp_path / "run", verbose=True)
    assert f"resuming after {SIZE:,} steps" in capsys.readouterr().out
    assert resumed.fingerprints == result.fingerprints
