"""Environments of Brax's and Gymnax's interfaces, called in one way, without these libraries."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.own_environments import GymnaxParams, Line, NoisyPoint, OwnState
from jetbot_mjx.envs.foreign import as_foreign
from jetbot_mjx.errors import InvalidError

KEY = jax.random.PRNGKey(2)


def brax(**state):
    """An environment whose reset and step return one state, but for what is given."""
    zero = jnp.zeros(())
    fields = {"obs": jnp.zeros(2), "reward": zero, "done": zero, "metrics": {}, "info": {}}
    made = OwnState(zero, zero, **fields | state)
    return SimpleNamespace(reset=lambda rng: made, step=lambda s, a: made, action_size=1)


def test_numbers_of_an_action_are_scaled_to_the_space():
    env = as_foreign((Line(discrete=False), GymnaxParams()))
    assert (env.action_size, env.is_discrete) == (2, False)
    begun = env.reset(KEY)
    for action, taken in [((-1, -1), (-2, 0)), ((1, 1), (2, 10)), ((0, 0.5), (0, 7.5))]:
        got = env.step(begun.kept, jnp.array(action, jnp.float32))
        np.testing.assert_allclose(got.obs[1:], taken)


def test_the_largest_number_chooses():
    env = as_foreign((Line(discrete=True), GymnaxParams()))
    assert (env.action_size, env.is_discrete) == (3, True)
    begun = env.reset(KEY)
    for choice in range(3):
        got = env.step(begun.kept, jax.nn.one_hot(choice, 3))
        np.testing.assert_array_equal(got.obs[1:], [choice, choice])


def test_gymnax_s_time_limit_is_left_to_the_trainer():
    env = as_foreign((Line(discrete=True), GymnaxParams(max_steps_in_episode=3)))
    now = env.reset(KEY)
    for _ in range(20):
        now = env.step(now.kept, jnp.zeros(3))
        assert (float(now.done), float(now.terminated)) == (0, 0)
    # The limit would have ended it.
    _, _, _, done, _ = Line(discrete=True).step_env(KEY, now.kept[1], 0, GymnaxParams())
    assert bool(done)


def test_gymnax_s_end_is_a_termination():
    env = as_foreign((Line(discrete=True), GymnaxParams(edge=0.0)))
    ended = env.step(env.reset(KEY).kept, jnp.zeros(3))
    assert (float(ended.done), float(ended.terminated)) == (1, 1)


def test_each_step_of_gymnax_draws_from_a_key_of_its_own():
    env = as_foreign((Line(discrete=True), GymnaxParams()))
    now, places = env.reset(KEY), []
    for _ in range(8):
        now = env.step(now.kept, jnp.zeros(3))
        places.append(float(now.obs[0]))
    assert len(set(np.diff(places))) == 7
    again = env.step(env.reset(KEY).kept, jnp.zeros(3))
    assert float(again.obs[0]) == places[0]


def test_an_environment_of_gymnax_without_parameters_has_its_own():
    assert as_foreign(Line(discrete=True)).action_size == 3


def test_the_size_of_an_action_is_told_or_that_of_the_model():
    assert as_foreign(NoisyPoint()).action_size == 2
    env = brax()
    del env.action_size
    env.mj_model = SimpleNamespace(nu=4)
    assert as_foreign(env).action_size == 4


@pytest.mark.parametrize(
    ("source", "told"),
    [
        (3, "int is no environment: it lacks reset and step"),
        (SimpleNamespace(reset=print), "SimpleNamespace is no environment: it lacks step"),
        (SimpleNamespace(reset=print, step=print), "action_size = None is wrong"),
        (SimpleNamespace(reset=print, step=print, action_size=0), "action_size = 0 is wrong"),
        (SimpleNamespace(reset=print, step=print, action_size=(2,)), r"action_size = \(2,\) is"),
    ],
)
def test_what_is_no_environment_is_refused(source, told):
    with pytest.raises(InvalidError, match=told):
        as_foreign(source)


@pytest.mark.parametrize(
    ("state", "told"),
    [
        ({"obs": jnp.zeros((3, 3))}, r"observation has the shape \[3, 3\]: it should be a vector"),
        (
            {"obs": {"a": jnp.zeros(2), "pixels": jnp.zeros((8, 8, 3))}},
            r"observation\['pixels'\] has the shape \[8, 8, 3\]",
        ),
        ({"obs": jnp.zeros(0)}, "observation is empty"),
        ({"obs": {"privileged_all": jnp.zeros(3)}}, "observation is empty"),
        ({"reward": jnp.zeros(2)}, r"reward has the shape \[2\]: it should be one number"),
        ({"done": jnp.zeros((1, 1))}, r"done has the shape \[1, 1\]"),
        ({"metrics": {"speed": jnp.zeros(2)}}, r"metrics\['speed'\] has the shape \[2\]"),
        ({"info": {"truncation": jnp.zeros(2)}}, r'info\["truncation"\] has the shape'),
        (
            {"metrics": {"kind": "walk"}},
            r"metrics\['kind'\] = 'walk' is wrong: it should be one num",
        ),
        (
            {"metrics": {"speed": None}},
            r"metrics\['speed'\] = None is wrong: it should be one number",
        ),
    ],
)
def test_a_result_of_the_wrong_shape_or_kind_is_refused(state, told):
    with pytest.raises(InvalidError, match=told):
        as_foreign(brax(**state)).reset(KEY)


def test_a_state_without_its_fields_is_refused():
    env = SimpleNamespace(reset=lambda rng: jnp.zeros(3), step=print, action_size=1)
    with pytest.raises(InvalidError, match="its state lacks obs, reward, done"):
        as_foreign(env).reset(KEY)


def test_success_in_info_becomes_a_metric():
    got = as_foreign(brax(info={"success": True}, metrics={"speed": 2})).reset(KEY)
    assert {name: float(x) for name, x in got.metrics.items()} == {"success": 1, "speed": 2}


def test_parts_of_an_observation_are_joined_in_the_order_of_their_names():
    parts = {"b": {"y": jnp.array([2.0]), "x": 1.0}, "a": jnp.array([0, 5]), "privileged_b": 9.0}
    env = as_foreign(brax(obs=parts))
    np.testing.assert_array_equal(env.reset(KEY).obs, [0, 5, 1, 2])
    assert list(env.parts.items()) == [("a", 2), ("b.x", 1), ("b.y", 1)]
