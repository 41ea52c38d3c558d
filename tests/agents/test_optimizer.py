"""The optimizer's state, read and written as optax itself leaves it."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jetbot_mjx.agents.optimizer import adapt_step_size, make_optimizer, read_adam, write_adam
from jetbot_mjx.config import parse_config

PARAMS = {"w": jnp.asarray([1.0, -2.0])}
GRADIENT = {"w": jnp.asarray([0.5, 0.25])}


def config(**ppo):
    return parse_config({"ppo": {"learning_rate": 0.01, **ppo}}).ppo


def after(optimizer, steps):
    """Parameters and state after some steps along the same gradient."""
    params, state = PARAMS, optimizer.init(PARAMS)
    for _ in range(steps):
        change, state = optimizer.update(GRADIENT, state, params)
        params = optax.apply_updates(params, change)
    return params, state


def test_a_step_is_adams_of_the_clipped_gradient():
    params, state = after(make_optimizer(config(max_grad_norm=0.1)), 1)
    # The first step of Adam is the step size along each sign.
    np.testing.assert_allclose(params["w"], [0.99, -2.01], rtol=1e-6)
    # A tenth of the gradient, whose norm is clipped from 0.559 to 0.1.
    clipped = np.asarray([0.5, 0.25]) * 0.1 / np.hypot(0.5, 0.25)
    np.testing.assert_allclose(read_adam(state).mu["w"], 0.1 * clipped, rtol=1e-5)
    unclipped = after(make_optimizer(config(max_grad_norm=None)), 1)[1]
    np.testing.assert_allclose(read_adam(unclipped).mu["w"], [0.05, 0.025], rtol=1e-5)


@pytest.mark.parametrize("schedule", ["NONE", "LINEAR", "ADAPTIVE_KL"])
@pytest.mark.parametrize("max_grad_norm", [None, 1.0])
def test_what_is_written_is_what_optax_would_have_left(schedule, max_grad_norm):
    optimizer = make_optimizer(config(learning_rate_schedule=schedule, max_grad_norm=max_grad_norm))
    _, start = after(optimizer, 2)
    _, end = after(optimizer, 5)
    adam = read_adam(end)
    assert int(adam.count) == 5
    written = write_adam(start, adam.rate, jnp.float32(3), adam.mu, adam.nu)
    assert jax.tree.structure(written) == jax.tree.structure(end)
    jax.tree.map(np.testing.assert_array_equal, written, end)


@pytest.mark.parametrize(
    ("kl", "expected"), [(0.1, 0.01 / 1.5), (0.001, 0.01 * 1.5), (0.01, 0.01), (0.0, 0.01)]
)
def test_the_divergence_moves_the_step_size(kl, expected):
    bounds = {"learning_rate_schedule_min_lr": 1e-3, "learning_rate_schedule_max_lr": 0.1}
    settings = config(learning_rate_schedule="ADAPTIVE_KL", desired_kl=0.01, **bounds)
    before = make_optimizer(settings).init(PARAMS)
    state = adapt_step_size(before, jnp.float32(kl), settings)
    np.testing.assert_allclose(read_adam(state).rate, expected, rtol=1e-6)
    # The state before it is left as it was.
    np.testing.assert_allclose(read_adam(before).rate, 0.01, rtol=1e-6)
