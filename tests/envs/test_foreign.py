"""Environments of other libraries, called in one way."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.own_environments import Gymlike, Named, Params, Point
from jetbot_mjx.envs.foreign import as_foreign
from jetbot_mjx.errors import UserError

KEY = jax.random.PRNGKey(0)


def test_numbers_are_scaled_to_the_limits_of_gymnax_s_space():
    one = as_foreign(Gymlike())
    assert (one.action_size, one.is_discrete) == (2, False)
    first = one.reset(KEY)
    for action, given in (((-1, 1), (-2, 2)), ((0, 0), (1, 0)), ((0.5, -0.5), (2.5, -1))):
        after = one.step(first.kept, jnp.float32(action))
        np.testing.assert_allclose(after.obs[:2], given, atol=1e-6)


def test_the_largest_number_chooses():
    one = as_foreign(Gymlike(choices=3))
    assert (one.action_size, one.is_discrete) == (3, True)
    first = one.reset(KEY)
    for action, choice in (((-1, -3, -2), 0), ((0, 0, 1), 2), ((0, 0.1, 0.05), 1)):
        assert one.step(first.kept, jnp.float32(action)).obs[0] == choice


def test_gymnax_s_time_limit_is_left_to_the_trainer():
    one = as_foreign(Gymlike())
    outcome = one.reset(KEY)
    for _ in range(Params().max_steps_in_episode + 2):
        outcome = one.step(outcome.kept, jnp.zeros(2))
        assert (float(outcome.done), float(outcome.terminated)) == (0, 0)
    # An end of its own is a termination.
    (key, state), far = outcome.kept, jnp.float32(1e4)
    outcome = one.step((key, state | {"x": far}), jnp.zeros(2))
    assert (float(outcome.done), float(outcome.terminated)) == (1, 1)


def test_gymnax_s_parameters_may_come_with_it():
    still = as_foreign((Gymlike(), Params(gain=0.0)))
    first = still.reset(KEY)
    assert still.step(first.kept, jnp.zeros(2)).obs[2] == first.obs[2]
    moving = as_foreign(Gymlike())
    first = moving.reset(KEY)
    one = moving.step(first.kept, jnp.zeros(2))
    two = moving.step(one.kept, jnp.zeros(2))
    assert len({float(x.obs[2]) for x in (first, one, two)}) == 3


def test_the_number_of_actions_may_be_the_model_s():
    class Modelled(Point):
        action_size = None
        mj_model = types.SimpleNamespace(nu=5)

    assert as_foreign(Modelled()).action_size == 5
    assert as_foreign(Named()).action_size == 2


def brax_like(**members):
    """An environment whose state has these members."""
    state = types.SimpleNamespace(obs=jnp.zeros(2), reward=0.0, done=0.0)
    for name, value in members.items():
        delattr(state, name) if value is None else setattr(state, name, value)
    return types.SimpleNamespace(reset=lambda rng: state, step=lambda *_: state, action_size=1)


@pytest.mark.parametrize(
    ("source", "told"),
    [
        (object(), "object is no environment: it lacks reset and step"),
        (types.SimpleNamespace(reset=print), "SimpleNamespace is no environment: it lacks step"),
        (
            types.SimpleNamespace(reset=print, step=print),
            "action_size = None is wrong: it should be a whole number",
        ),
        (
            types.SimpleNamespace(reset=print, step=print, action_size=0),
            "action_size = 0 is wrong: it should be a whole number",
        ),
        (brax_like(obs=None, done=None), "its state lacks obs, done"),
        (
            brax_like(obs={"image": jnp.zeros((4, 4, 3))}),
            "observation['image'] has the shape [4, 4, 3]: it should be a vector, such as x.ravel",
        ),
        (brax_like(obs={"privileged_state": jnp.zeros(3)}), "observation is empty"),
        (brax_like(obs=jnp.zeros(0)), "observation is empty"),
        (
            brax_like(reward=jnp.zeros(1)),
            "reward has the shape [1]: it should be one number, of one instance",
        ),
        (brax_like(done=jnp.zeros(2)), "done has the shape [2]: it should be one number"),
        (brax_like(metrics={"a": jnp.zeros(3)}), "metrics['a'] has the shape [3]"),
        (brax_like(info={"truncation": jnp.zeros(1)}), 'info["truncation"] has the shape [1]'),
    ],
)
def test_what_breaks_the_interface_is_told(source, told):
    with pytest.raises(UserError) as caught:
        as_foreign(source).reset(KEY)
    assert told in str(caught.value)
