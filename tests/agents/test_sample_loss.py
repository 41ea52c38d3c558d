"""The loss of one sample, lowered for CPUs and GPUs, against the gradient of `ppo_loss`.

The samples are not gentle: actions at the ends of their range, ratios far outside of the range
where nothing is clipped, advantages of zero, and standard deviations as small as they can be.
"""

import types
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import losses
from brax.training.distribution import NormalDistribution, NormalTanhDistribution

from helpers.run_program import evaluate
from jetbot_mjx.agents import gae
from jetbot_mjx.agents.brax_parts import Transition
from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.shapes import LossTerms, UpdateShape
from jetbot_mjx.agents.loss import ppo_loss
from jetbot_mjx.config import parse_config

ACTIONS, COUNT = 2, 4000
TERMS = LossTerms(
    clipping_epsilon=0.3,
    entropy_cost=0.02,
    vf_loss_coefficient=0.7,
    discounting=0.9,
    gae_lambda=0.8,
    reward_scaling=2.0,
)
KEY = jax.random.PRNGKey(5)


class Samples(NamedTuple):
    """Samples as the collection hands them on, and what the network makes of them now."""

    outputs: Any
    deviations: Any
    raw_action: Any
    log_prob: Any
    old: Any
    advantage: Any


def shape_of(distribution):
    return UpdateShape(3, 16, 1, ACTIONS, distribution, "tanh", normalizes=False)


def distribution_of(shape):
    if shape.deviations:
        return NormalDistribution(ACTIONS)
    return NormalTanhDistribution(ACTIONS)


def drawn(distribution, seed, differences):
    """Samples whose actions have been drawn, with given differences of their log-probabilities."""
    rng, shape = np.random.default_rng(seed), shape_of(distribution)

    def spread(*choices):
        # Some of every size.
        sizes = rng.choice(choices, size=(COUNT, 1))
        return sizes * rng.normal(size=(COUNT, ACTIONS))

    mean, noise = np.clip(spread(0.1, 1.0, 6.0), -10, 10), rng.normal(size=(COUNT, ACTIONS))
    # From the smallest deviation, 0.001, to some that saturate every tanh.
    logits = rng.choice([-30.0, -9.0, -3.0, 0.0, 1.0, 5.0], size=(COUNT, ACTIONS))
    scale = np.logaddexp(logits, 0) + 0.001
    raw = np.float32(mean) + np.float32(scale * noise)
    old_scale = np.exp(spread(0.3)) * scale
    if shape.deviations:
        outputs, deviations, old = mean, scale, [mean + 0.1 * spread(1.0), old_scale]
    else:
        outputs = np.concatenate([mean, logits], -1)
        deviations, old = np.zeros((COUNT, ACTIONS)), [mean + 0.1 * spread(1.0), spread(1.0, 4.0)]
    advantage = rng.choice([-30.0, -1.0, 0.0, 1.0, 2.5], size=COUNT) * rng.choice([1, 0.1], COUNT)
    made = Samples(outputs, deviations, raw, 0.0, np.concatenate(old, -1), advantage)
    made = Samples(*(np.float32(x) for x in made))
    with jax.enable_x64(True):
        wide = Samples(*(np.float64(x) for x in made))
        log_prob = distribution_of(shape).log_prob(parameters(wide, shape), wide.raw_action)
    log_prob = np.asarray(log_prob) - rng.choice(differences, COUNT)
    return made._replace(log_prob=log_prob.astype(np.float32))


def parameters(samples, shape):
    return (samples.outputs, samples.deviations) if shape.deviations else samples.outputs


def of_brax(samples, shape, dtype):
    """The gradients and the metrics of `ppo_loss`, whose networks return what they are given."""
    config = parse_config(
        {
            "ppo": {
                **TERMS._asdict(),
                "normalize_advantage": False,
                "network": {"distribution_type": "normal" if shape.deviations else "tanh_normal"},
            }
        }
    ).ppo
    apply = types.SimpleNamespace(apply=lambda _, given, __: given)
    networks = types.SimpleNamespace(
        policy_network=apply,
        value_network=types.SimpleNamespace(apply=lambda _, given, x: jnp.zeros(x.shape[:-1])),
        parametric_action_distribution=distribution_of(shape),
    )
    old = samples.old[None]
    old = (old[..., :ACTIONS], old[..., ACTIONS:]) if shape.deviations else old
    # One unroll for each sample; without values, the advantage is the reward.
    batch = Transition(
        observation=jnp.zeros((1, COUNT, 1)),
        action=samples.raw_action[None],
        reward=(samples.advantage / TERMS.reward_scaling)[None],
        discount=jnp.ones((1, COUNT)),
        next_observation=jnp.zeros((1, COUNT, 1)),
        extras={
            "policy_extras": {
                "log_prob": samples.log_prob[None],
                "raw_action": samples.raw_action[None],
                "distribution_params": old,
            },
            "state_extras": {"truncation": jnp.zeros((1, COUNT))},
        },
    )
    batch = jax.tree.map(lambda x: jnp.swapaxes(jnp.asarray(x, dtype), 0, 1), batch)
    given = jax.tree.map(lambda x: jnp.asarray(x, dtype)[None], parameters(samples, shape))

    def loss(policy):
        params = losses.PPONetworkParams(policy=policy, value=None)
        return ppo_loss(params, None, batch, KEY, networks=networks, config=config)

    gradient, metrics = jax.jit(jax.grad(loss, has_aux=True))(given)
    gradient = np.concatenate([np.asarray(x[0], np.float64) for x in jax.tree.leaves(gradient)], -1)
    names = "policy_loss", "entropy_loss", "kl_mean", "policy_dist_mean_std"
    return gradient * COUNT, [float(metrics[name]) for name in names]


def of_kernels(samples, shape, *, for_gpu):
    """The same by the program that the kernels run."""
    program = sample_loss.policy_program(shape, COUNT, for_gpu=for_gpu)
    noise = jax.random.normal(KEY, (1, COUNT, ACTIONS))[0]
    names = samples.raw_action, samples.log_prob, samples.old, noise, samples.advantage
    leaves = [samples.outputs, samples.deviations, *names, np.ones(COUNT)]
    leaves += [np.full(COUNT, term) for term in TERMS]
    leaves = [np.asarray(x, np.float32).reshape(COUNT, *np.shape(x)[1:]) for x in leaves]
    results = evaluate(program, leaves)
    metrics = [np.mean(x, dtype=np.float64) for x in results[-4:]]
    metrics[1] *= -TERMS.entropy_cost
    metrics[3] /= ACTIONS
    return np.concatenate(results[:-4], -1).astype(np.float64) * COUNT, metrics


DIFFERENCES = [0.0, 0.1, -0.1, 0.5, -0.5, 3.0, -3.0, 20.0, -20.0]


@pytest.mark.parametrize(("for_gpu", "bound"), [(False, 1e-5), (True, 5e-4)])
@pytest.mark.parametrize("distribution", ["tanh_normal", "normal"])
def test_the_gradient_is_that_of_the_loss_in_float64(distribution, for_gpu, bound):
    shape = shape_of(distribution)
    samples = drawn(distribution, 1, DIFFERENCES)
    with jax.enable_x64(True):
        # The same noise in both.
        noise = np.asarray(jax.random.normal(KEY, (1, COUNT, ACTIONS), jnp.float32))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jax.random, "normal", lambda *_, **__: jnp.float64(noise))
            expected, expected_metrics = of_brax(samples, shape, jnp.float64)
    theirs, _ = of_brax(samples, shape, jnp.float32)
    ours, metrics = of_kernels(samples, shape, for_gpu=for_gpu)
    size = np.abs(expected).max(-1, keepdims=True) + 1e-6
    assert (np.abs(ours - expected) <= bound * size).all()
    np.testing.assert_allclose(metrics, expected_metrics, rtol=1e-4)
    # On the whole, no further off than XLA's.
    errors = [np.sqrt(np.mean(((x - expected) / size) ** 2)) for x in (ours, theirs)]
    assert errors[0] < errors[1]


@pytest.mark.parametrize("for_gpu", [False, True])
@pytest.mark.parametrize("distribution", ["tanh_normal", "normal"])
def test_the_gradient_is_finite_where_that_of_the_loss_is(distribution, for_gpu):
    shape = shape_of(distribution)
    samples = drawn(distribution, 2, [*DIFFERENCES, 80.0, -80.0, 100.0, -1e4, -1e30])
    samples = samples._replace(outputs=np.where(samples.outputs < -20, -200, samples.outputs))
    expected, _ = of_brax(samples, shape, jnp.float32)
    ours, _ = of_kernels(samples, shape, for_gpu=for_gpu)
    there = np.isfinite(expected)
    assert 0.8 < there.mean() < 1
    assert np.isfinite(ours[there]).all()


@pytest.mark.parametrize("name", ["tanh", "relu", "elu", "swish"])
def test_activations_have_the_derivatives_of_jax(name):
    z = np.float32([*np.linspace(-20, 20, 999), -1e4, -90, 90, 1e4])
    program = sample_loss.scalarize(lambda x: sample_loss.activation(name, x), jnp.zeros(()))
    value, slope = evaluate(program, [z])
    with jax.enable_x64(True):
        function = jax.vmap(jax.value_and_grad(getattr(jax.nn, name)))
        expected = function(np.float64(z))
    np.testing.assert_allclose(value, expected[0], rtol=1e-6, atol=3e-7)
    np.testing.assert_allclose(slope, expected[1], rtol=1e-6, atol=3e-7)


def test_a_run_of_value_steps_is_generalised_advantage_estimation():
    rng, time, unrolls = np.random.default_rng(3), 20, 50
    value, reward = rng.normal(size=(2, time, unrolls)).astype(np.float32)
    last = np.float32(rng.normal(size=unrolls))
    discount, truncation = np.float32(rng.uniform(size=(2, time, unrolls)) < [[[0.8]], [[0.2]]])
    program = sample_loss.value_step_program(time * unrolls)
    results, following = [], [last, last, np.zeros_like(last)]
    for t in reversed(range(time)):
        step = [value[t], reward[t], discount[t], truncation[t], *following, *TERMS]
        given = [np.broadcast_to(np.float32(x), last.shape) for x in step]
        *estimates, a, b, c = evaluate(program, given)
        results.append(estimates)
        following = [a, b, c]
    advantage, slope, square = (np.stack(x[::-1]) for x in zip(*results, strict=True))
    given = truncation, (1 - discount) * (1 - truncation), reward * TERMS.reward_scaling
    # Brax's own, with its loop.
    targets, advantages = losses.compute_gae(
        *given, value, last, TERMS.gae_lambda, TERMS.discounting
    )

    def loss(value):
        return 0.5 * TERMS.vf_loss_coefficient * jnp.mean((targets - value) ** 2)

    np.testing.assert_allclose(advantage, advantages, atol=3e-6)
    np.testing.assert_allclose(square, (targets - value) ** 2, atol=3e-5)
    np.testing.assert_allclose(slope, jax.grad(loss)(value), atol=1e-8)


def test_the_equations_of_the_kernels_are_those_of_the_unrolled_estimation(monkeypatch):
    zeros, ones = np.zeros((3, 2), np.float32), np.ones((3, 2), np.float32)

    def estimates():
        return gae.compute_gae(zeros, zeros, ones, ones, np.ones(2, np.float32))

    before = estimates()
    monkeypatch.setattr(gae, "gae_step", lambda delta, factor, next_gae: delta)
    assert not np.array_equal(estimates()[0], before[0])
    monkeypatch.undo()
    assert sample_loss.gae_step is gae.gae_step
    assert sample_loss.td_error is gae.td_error
