"""The data of a collection: the order of its axes, its keys, and the first non-finite state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.types import Transition

from jetbot_mjx.agents.unrolls import action_keys, find_nan_dump, joined
from jetbot_mjx.packed import pack

TIME, ENVIRONMENTS = 3, 4
START = pack({"state": jnp.arange(ENVIRONMENTS) * 10}, batch_axes=1)


def data(*broken):
    """An unroll, in which some (time, environment) ended in a non-finite state."""
    nonfinite = np.zeros((TIME, ENVIRONMENTS), np.float32)
    for place in broken:
        nonfinite[place] = 1
    # In the last environment, an episode goes on after such a state; it is counted when it ends.
    ended = nonfinite.copy()
    counted = nonfinite.copy()
    counted[:, -1] = 1
    number = np.arange(TIME * ENVIRONMENTS, dtype=np.float32).reshape(TIME, ENVIRONMENTS)
    return Transition(
        observation=number,
        action=number[..., None],
        reward=number,
        discount=number,
        next_observation=None,
        extras={
            "state_extras": {
                "episode_metrics": {"nonfinite_envs": jnp.asarray(counted)},
                "episode_done": jnp.asarray(ended),
            }
        },
    )


@pytest.mark.parametrize(
    ("broken", "step", "environment"),
    [([(1, 2)], 1, 2), ([(2, 0), (1, 3)], 1, 3), ([(0, 3), (0, 1)], 0, 1)],
)
def test_the_first_nonfinite_state_is_found(broken, step, environment):
    dump = find_nan_dump(START, data(*broken))
    assert bool(dump.found)
    assert int(dump.step) == step
    assert int(dump.env_state.unpack()["state"]) == environment * 10
    actions = environment + ENVIRONMENTS * np.arange(TIME)
    np.testing.assert_array_equal(dump.actions[:, 0], actions)


def test_without_one_there_is_none():
    assert not bool(find_nan_dump(START, data()).found)


def test_unrolls_of_all_environments_lie_one_after_the_other():
    several = jax.tree.map(lambda x: jnp.stack([x, x + TIME * ENVIRONMENTS]), data())
    found = joined(several).reward
    assert found.shape == (2 * ENVIRONMENTS, TIME)
    # The second environment of the first unroll, and the first one of the second.
    np.testing.assert_array_equal(found[1], [1, 5, 9])
    np.testing.assert_array_equal(found[ENVIRONMENTS], [12, 16, 20])


def test_each_key_of_an_action_follows_from_the_one_before():
    key = jax.random.PRNGKey(4)
    found = action_keys(key, TIME)
    for one in found:
        own, key = jax.random.split(key)
        np.testing.assert_array_equal(one, own)
