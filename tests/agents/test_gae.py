"""Advantages without a loop against Brax's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import losses

from jetbot_mjx.agents import gae

brax = losses.compute_gae


def data(time, seed=0):
    rng = np.random.default_rng(seed)
    ends = rng.uniform(size=(2, time, 32)) < 0.1
    numbers = rng.normal(size=(2, time, 32))
    arrays = [*ends.astype(np.float32), *numbers.astype(np.float32)]
    return [*map(jnp.asarray, arrays), jnp.asarray(rng.normal(size=32), jnp.float32)]


@pytest.mark.parametrize("time", [1, 2, 16, 64])
@pytest.mark.parametrize(("lambda_", "discount"), [(0.95, 0.97), (1.0, 0.9), (0.0, 1.0)])
def test_targets_and_advantages_are_braxs(time, lambda_, discount):
    given = data(time)
    ours = gae.compute_gae(*given, lambda_=lambda_, discount=discount)
    for one, other in zip(ours, brax(*given, lambda_=lambda_, discount=discount), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


def loops(function, *arguments):
    return str(jax.make_jaxpr(function)(*arguments)).count("scan[")


def test_there_is_no_loop_but_for_long_unrolls():
    assert loops(brax, *data(16)) == 1
    assert loops(gae.compute_gae, *data(64)) == 0
    assert loops(gae.compute_gae, *data(65)) == 1


def test_no_gradient_passes():
    truncation, termination, rewards, values, bootstrap = data(4)

    def total(values):
        made = gae.compute_gae(truncation, termination, rewards, values, bootstrap)
        return sum(x.sum() for x in made)

    assert not np.any(jax.grad(total)(values))
