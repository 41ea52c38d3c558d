"""An environment of one's own behind the interface of the trainer."""

import collections
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.own_environments import ZERO, Lever, NoisyPoint, OwnState, adapted
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import UserError

Physics = collections.namedtuple("Physics", ("qpos", "qvel"))
KEY = jax.random.PRNGKey(5)


def options(**given):
    return {"environment_options": given}


def drive(env, actions, key=KEY):
    """The states of an episode, the first one included."""
    states = [jax.jit(env.reset)(key)]
    step = jax.jit(env.step)
    for action in actions:
        states.append(step(states[-1], jnp.asarray(action)))
    return states


def test_only_what_a_step_reads_is_kept():
    kept = adapted(NoisyPoint).reset(KEY).pipeline_state.kept
    assert set(kept) == {"place", "info['key']", "info['count']"}
    assert kept["info['key']"].dtype == jnp.uint32


def test_what_a_step_reads_through_another_leaf_is_kept():
    class Chain(Lever):
        def step(self, state, action):
            # `place` follows from `unread`, and only `place` is shown.
            return state.replace(
                place=state.unread,
                unread=state.unread + 1.0,
                obs=state.place,
                reward=jnp.zeros(()),
                done=jnp.zeros(()),
            )

    env = adapted(Chain)
    assert set(env.reset(KEY).pipeline_state.kept) == {"place", "unread"}
    shown = [float(state.obs[0]) for state in drive(env, [[1.0, 0.0]] * 4)]
    assert shown == [0.0, 0.0, 0.0, 1.0, 2.0]


@pytest.mark.parametrize("old_keys", [True, False])
def test_a_trajectory_is_that_of_ones_own_reset_and_step(old_keys):
    env, own = adapted(NoisyPoint, **options(old_keys=old_keys)), NoisyPoint(old_keys)
    actions = np.random.default_rng(0).uniform(-2, 2, (5, 2)).astype(np.float32)
    states = drive(env, actions)
    expected = jax.jit(own.reset)(jax.random.split(KEY)[1])
    for state, action in itertools.zip_longest(states, actions):
        place = np.asarray(expected.place)
        np.testing.assert_allclose(state.obs, [place[1], place[0]], rtol=1e-6)
        np.testing.assert_allclose(state.reward, expected.reward, rtol=1e-6)
        np.testing.assert_allclose(state.metrics["distance"], expected.metrics["distance"])
        assert (state.done, state.reward.dtype) == (expected.done, jnp.float32)
        if action is not None:
            expected = jax.jit(own.step)(expected, jnp.clip(action, -1.0, 1.0))


def test_an_observation_is_joined_without_what_is_privileged():
    env = adapted(NoisyPoint)
    assert (env.observation_size, env.action_size) == (2, 2)
    assert [field.size for field in env.layout] == [1, 1]
    assert env.reset(KEY).obs.shape == (2,)
    assert env.observation_min_std is None


def test_a_time_limit_of_its_own_is_a_truncation():
    states = drive(adapted(NoisyPoint, **options(limit=3, edge=9.0)), np.zeros((3, 2), np.float32))
    assert [float(state.done) for state in states] == [0, 0, 0, 1]
    assert [float(state.info["terminated"]) for state in states] == [0, 0, 0, 0]
    batch = wrap_for_training(adapted(NoisyPoint, **options(limit=3, edge=9.0)), episode_length=100)
    state = jax.jit(batch.reset)(KEY[None])
    step = jax.jit(batch.step)
    for _ in range(3):
        state = step(state, jnp.zeros((1, 2)))
    assert (float(state.info["truncation"][0]), float(state.info["terminated"][0])) == (1, 0)


def test_an_end_by_failure_is_a_termination():
    states = drive(adapted(NoisyPoint, **options(edge=0.0)), np.ones((1, 2), np.float32))
    assert (float(states[-1].done), float(states[-1].info["terminated"])) == (1, 1)


def test_terminated_in_info_is_taken_as_it_is():
    class Told(Lever):
        def reset(self, rng):
            return super().reset(rng).replace(info={"terminated": jnp.zeros(())})

        def step(self, state, action):
            # An environment that says it twice need not say it alike.
            return state.replace(info={"terminated": jnp.ones(())}, place=state.place + 1.0)

    last = drive(adapted(Told), [[1.0, 0.0]])[-1]
    assert (float(last.info["terminated"]), float(last.done)) == (1, 1)


def test_a_success_counts_once_in_an_episode():
    env = adapted(NoisyPoint, **options(edge=9.0))
    assert env.has_success
    assert not adapted(Lever).has_success
    states = drive(env, np.ones((12, 2), np.float32))
    told = [float(state.metrics["success"]) for state in states]
    assert sum(told) == 1
    # The environment itself tells it from that step on.
    assert float(states[-1].obs[1]) > 0
    assert told[-1] == 0


def test_each_episode_begins_elsewhere():
    batch = wrap_for_training(adapted(NoisyPoint, **options(edge=9.0)), episode_length=2)
    state = jax.jit(batch.reset)(jax.random.split(KEY, 4))
    step, starts = jax.jit(batch.step), [np.asarray(state.obs)]
    for count in range(6):
        state = step(state, jnp.zeros((4, 2)))
        assert (np.asarray(state.done) == (count % 2)).all()
        if count % 2:
            starts.append(np.asarray(state.obs))
    assert len(np.unique(np.concatenate(starts), axis=0)) == 16


def test_an_environment_that_draws_nothing_and_one_number_to_observe():
    env = adapted(Lever)
    states = drive(env, [[0.0, 1.0], [1.0, 0.0]])
    assert [float(state.reward) for state in states] == [0.0, 1.0, -1.0]
    assert (env.observation_size, env.is_discrete, env.metrics) == (1, True, ())


def test_numbers_of_python_and_numpy_become_arrays_of_jax():
    class Python(Lever):
        def reset(self, rng):
            return OwnState(0, np.float64(1.0), np.zeros(3), 0.0, False, {"a": 0.0}, {})

        def step(self, state, action):
            return state.replace(place=state.place + 1, metrics={"a": 1.0}, done=state.place > 2)

    states = drive(adapted(Python), [[1.0, 0.0]] * 4)
    assert [float(state.done) for state in states] == [0, 0, 0, 0, 1]
    dtypes = {leaf.dtype.name for leaf in jax.tree.leaves(states[-1])}
    assert dtypes == {"float32", "int32", "uint32"}


def test_a_state_with_what_is_no_number_is_refused_by_its_name():
    class Named(Lever):
        def reset(self, rng):
            return super().reset(rng).replace(info={"kind": "walk", "none": None})

    with pytest.raises(UserError, match=r"the state's info\['kind'\] = 'walk' is wrong: it should"):
        adapted(Named)


@pytest.mark.parametrize("name", ["length", "sum_reward"])
def test_a_metric_takes_no_place_among_the_sums_of_an_episode(name):
    class Measured(Lever):
        def reset(self, rng):
            return super().reset(rng).replace(metrics={name: ZERO})

        def step(self, state, action):
            return super().step(state, action).replace(metrics={name: ZERO - 7})

    plain, measured = (
        drive(wrap_for_training(adapted(one), 8), [[[1.0, 0.0]]] * 2, KEY[None])[-1]
        for one in (Lever, Measured)
    )
    sums = measured.info["episode_metrics"]
    assert float(sums["length"][0]) == 2
    assert float(sums["sum_reward"][0]) == float(plain.info["episode_metrics"]["sum_reward"][0])


def test_a_step_that_changes_the_state_is_refused():
    class Changing(Lever):
        def step(self, state, action):
            return state.replace(place=state.place * jnp.ones(2))

    with pytest.raises(UserError, match=r"state's place from float32\[\] to float32\[2\]: keep"):
        adapted(Changing)


@pytest.mark.parametrize(
    ("environment", "kind", "told"),
    [
        (Lever, "tanh_normal", "its actions are 2 choices: set categorical"),
        (NoisyPoint, "categorical", "its actions are numbers: set tanh_normal"),
    ],
)
def test_a_distribution_that_does_not_fit_is_refused(environment, kind, told):
    settings = {
        "environment": f"helpers.own_environments:{environment.__name__}",
        "ppo": {"network": {"distribution_type": kind}},
    }
    with pytest.raises(UserError, match=told):
        AdaptedEnv(parse_config(settings), environment)


def test_what_it_says_of_itself():
    env = adapted(NoisyPoint)
    assert repr(env) == (
        "AdaptedEnv('helpers.own_environments:NoisyPoint', observation_size=2, action_size=2)"
    )
    assert (env.dt, env.mj_model, env.backend, env.camera) == (None, None, "none", None)
    NoisyPoint.dt = 0.05
    try:
        assert env.dt == 0.05
    finally:
        del NoisyPoint.dt


@pytest.mark.parametrize("kind", [Physics, lambda qpos, qvel: {"qpos": qpos, "qvel": qvel}])
def test_a_state_of_mujoco_can_be_shown(kind):
    mujoco = pytest.importorskip("mujoco")

    class Physical(Lever):
        def __init__(self):
            joint = '<joint type="slide"/><geom size="0.1"/>'
            text = f"<mujoco><worldbody><body>{joint}</body></worldbody></mujoco>"
            self.mj_model = mujoco.MjModel.from_xml_string(text)

        def reset(self, rng):
            state = super().reset(rng)
            return state.replace(place=kind(jnp.ones(1), jnp.ones(1)))

        def step(self, state, action):
            place = jax.tree.map(lambda x: x + 1, state.place)
            return state.replace(place=place, obs=jax.tree.leaves(place)[0][0])

    env = adapted(Physical)
    assert env.mj_model is env.source.mj_model
    np.testing.assert_array_equal(env.qpos(env.reset(KEY)), [1.0])
