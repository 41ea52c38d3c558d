"""Termination, truncation and resets: with a stub that ends on demand, and with the robot."""

import itertools

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.envs.state import PhysicsState, State
from jetbot_mjx.envs.wrappers import EpisodeWrapper, NewEpisodeWrapper, wrap_for_training
from jetbot_mjx.packed import pack
from onekernel.build import BACKENDS

ENVS = 64
EPISODES = 20
EPISODE_LENGTH = 4


class Stub(brax.envs.Env):
    """Does what the action says: [0] is the reward, [1] > 0.5 terminates, < -0.5 is non-finite."""

    def reset(self, rng):
        key, goal_key = jax.random.split(rng)
        goal = jax.random.uniform(goal_key, (3,))
        zero = jnp.zeros(())
        physics = PhysicsState(jnp.zeros(9), jnp.zeros(8), jnp.zeros(8), zero)
        metrics = {"success": zero, "reward/given": zero}
        return State(physics, goal, zero, zero, metrics, {"terminated": zero}, goal, key)

    def step(self, state, action):
        terminated = (action[1] > 0.5).astype(jnp.float32)
        bad = jnp.where(action[1] < -0.5, jnp.nan, 0.0)
        physics = state.pipeline_state.replace(
            qpos=state.pipeline_state.qpos + 1.0 + bad, time=state.pipeline_state.time + 1.0
        )
        return state.replace(
            pipeline_state=physics,
            obs=state.goal + physics.qpos[:3],
            reward=action[0] + bad,
            done=terminated,
            metrics={**state.metrics, "success": terminated, "reward/given": action[0]},
            info={**state.info, "terminated": terminated},
        )

    observation_size = 3
    action_size = 2
    backend = "stub"


def chain(action_repeat=1):
    return NewEpisodeWrapper(EpisodeWrapper(Stub(), EPISODE_LENGTH, action_repeat))


GO, END, BLOW_UP = jnp.array([1.0, 0.0]), jnp.array([1.0, 1.0]), jnp.array([1.0, -1.0])


def run(env, actions, key=0):
    state = env.reset(jax.random.PRNGKey(key))
    states = [state]
    for action in actions:
        states.append(env.step(states[-1], action))
    return states


def test_the_time_limit_truncates_and_does_not_terminate():
    states = run(chain(), [GO] * 4)
    assert [float(s.done) for s in states[1:]] == [0, 0, 0, 1]
    assert [float(s.info["truncation"]) for s in states[1:]] == [0, 0, 0, 1]
    assert [float(s.info["terminated"]) for s in states[1:]] == [0, 0, 0, 0]
    assert [float(s.info["steps"]) for s in states[1:]] == [1, 2, 3, 4]


def test_termination_is_not_truncation_even_in_the_last_step():
    for actions in ([GO, END], [GO, GO, GO, END]):
        last = run(chain(), actions)[-1]
        assert float(last.done) == float(last.info["terminated"]) == 1
        assert float(last.info["truncation"]) == 0


def test_a_reset_draws_a_new_goal_and_key_and_clears_the_statistics():
    states = run(chain(), [GO, END, GO])
    first, ended, begun = states[1], states[2], states[3]
    assert not np.allclose(first.goal, ended.goal)
    assert not np.array_equal(first.key, ended.key)
    np.testing.assert_array_equal(ended.pipeline_state.qpos, 0.0)
    assert float(ended.info["steps"]) == 2  # still the old episode's
    assert float(begun.info["steps"]) == 1
    assert float(ended.info["episode_metrics"]["sum_reward"]) == 2
    assert float(begun.info["episode_metrics"]["sum_reward"]) == 1
    assert float(ended.info["episode_metrics"]["success"]) == 1
    assert float(begun.info["episode_metrics"]["length"]) == 1


def test_obs_belongs_to_the_new_episode_and_final_obs_to_the_old():
    first, ended = run(chain(), [GO, END])[1:]
    np.testing.assert_allclose(ended.obs, ended.goal)
    np.testing.assert_allclose(ended.info["final_obs"], first.goal + 2.0)
    np.testing.assert_allclose(first.info["final_obs"], first.obs)


def test_a_non_finite_state_ends_the_episode_is_counted_and_reset():
    before, blown, after = run(chain(), [GO, BLOW_UP, GO])[1:]
    assert float(blown.done) == float(blown.info["truncation"]) == 1
    assert float(blown.info["terminated"]) == 0
    assert float(blown.metrics["nonfinite_envs"]) == 1
    assert float(blown.info["episode_metrics"]["nonfinite_envs"]) == 1
    assert float(blown.reward) == 0
    np.testing.assert_array_equal(blown.info["final_obs"], before.obs)  # the last finite one
    for state in (blown, after):
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(state))
    assert float(after.metrics["nonfinite_envs"]) == 0
    np.testing.assert_array_equal(after.pipeline_state.qpos, 1.0)


class Unborn(Stub):
    """Some resets observe what is not finite."""

    def reset(self, rng):
        state = super().reset(rng)
        return state.replace(obs=jnp.where(state.goal[0] < 0.5, jnp.nan, state.goal))


def test_a_reset_that_is_not_finite_is_observed_as_zeros_and_its_first_step_is_counted():
    env = NewEpisodeWrapper(EpisodeWrapper(Unborn(), EPISODE_LENGTH))
    seen = []
    for key in range(8):
        states = run(env, [END] * 6, key)
        for before, after in itertools.pairwise(states):
            assert all(np.all(np.isfinite(x)) for x in (before.obs, before.info["final_obs"]))
            is_bad = bool(before.goal[0] < 0.5)
            assert np.any(before.obs) != is_bad
            assert float(after.metrics["nonfinite_envs"]) == is_bad
            assert float(after.info["truncation"]) == is_bad
            assert float(after.done) == 1
            assert float(after.reward) == 1 - is_bad
            seen.append(is_bad)
    assert 10 < sum(seen) < 38


def test_brax_masks_the_step_of_a_non_finite_state():
    from brax.training.agents.ppo.losses import compute_gae

    blown = run(chain(), [GO, BLOW_UP])[-1]
    truncation, done = blown.info["truncation"], blown.done
    _, advantage = compute_gae(
        truncation=truncation.reshape(1, 1),
        termination=(done * (1 - truncation)).reshape(1, 1),
        rewards=jnp.full((1, 1), 7.0),
        values=jnp.full((1, 1), 3.0),
        bootstrap_value=jnp.full(1, 5.0),
    )
    np.testing.assert_array_equal(advantage, 0.0)


def test_action_repeat_adds_rewards_and_stops_at_the_end():
    state = run(chain(action_repeat=2), [GO])[-1]
    assert (float(state.reward), float(state.info["steps"])) == (2, 2)
    ended = run(chain(action_repeat=3), [END])[-1]
    assert (float(ended.reward), float(ended.info["steps"])) == (1, 1)


def test_action_repeat_adds_up_terms_as_it_does_rewards():
    first, second = run(chain(action_repeat=3), [GO, 2 * GO])[1:]
    assert float(first.metrics["reward/given"]) == float(first.reward) == 3
    assert float(second.metrics["reward/given"]) == float(second.reward) == 2
    sums = second.info["episode_metrics"]
    assert float(sums["reward/given"]) == float(sums["sum_reward"]) == 5
    assert float(sums["nonfinite_envs"]) == 0
    ended = run(chain(action_repeat=3), [END])[-1]
    assert float(ended.metrics["success"]) == float(ended.info["episode_metrics"]["success"]) == 1


def test_action_repeat_stops_at_the_time_limit():
    first, last, begun = run(chain(action_repeat=3), [GO] * 3)[1:]
    assert [float(s.info["steps"]) for s in (first, last, begun)] == [3, EPISODE_LENGTH, 3]
    assert float(last.info["episode_metrics"]["length"]) == EPISODE_LENGTH
    assert float(last.done) == float(last.info["truncation"]) == 1
    # No step beyond the limit: the observation counts them.
    np.testing.assert_allclose(last.info["final_obs"], first.goal + EPISODE_LENGTH)


def test_a_non_finite_state_during_action_repeat_adds_no_reward():
    before, blown = run(chain(action_repeat=2), [GO, BLOW_UP])[1:]
    assert float(blown.reward) == float(blown.metrics["reward/given"]) == 0
    assert float(blown.info["episode_metrics"]["reward/given"]) == 2
    assert float(blown.metrics["nonfinite_envs"]) == 1
    np.testing.assert_array_equal(blown.info["final_obs"], before.obs)


def test_the_wrapped_state_keeps_its_tree_shapes_and_dtypes():
    for repeat in (1, 2):
        first, second = run(chain(repeat), [GO])
        assert jax.tree.structure(first) == jax.tree.structure(second)
        shapes = [jax.tree.map(lambda x: (x.shape, x.dtype), s) for s in (first, second)]
        assert shapes[0] == shapes[1]


@pytest.fixture(scope="module")
def driven():
    """64 robots through 20 episodes each: what every step told, on the host."""
    env = make_env(parse_config({"task": {"observation": "world"}}))
    batch = wrap_for_training(env, EPISODE_LENGTH)

    @jax.jit
    def drive(keys):
        def step(state, _):
            nstate = batch.step(state, jnp.zeros((ENVS, 2)))
            told = (nstate.goal, nstate.obs, nstate.info["final_obs"], nstate.done, state.goal)
            return nstate, told

        return jax.lax.scan(step, batch.reset(keys), length=EPISODES * EPISODE_LENGTH)[1]

    return jax.device_get(drive(jax.random.split(jax.random.PRNGKey(3), ENVS)))


def test_64_environments_see_20_different_goals_in_20_episodes(driven):
    _, _, _, done, goal_before = driven
    np.testing.assert_array_equal(done.sum(axis=0), EPISODES)
    ends = goal_before[EPISODE_LENGTH - 1 :: EPISODE_LENGTH]
    assert ends.shape == (EPISODES, ENVS, 3)
    for environment in range(ENVS):
        assert len(np.unique(ends[:, environment], axis=0)) == EPISODES
    assert len(np.unique(ends.reshape(-1, 3), axis=0)) == EPISODES * ENVS


def test_after_the_end_obs_tells_of_the_new_goal_and_final_obs_of_the_old(driven):
    goal, obs, final_obs, done, goal_before = driven
    ended = done > 0
    np.testing.assert_array_equal(obs[..., 13:16], goal)
    np.testing.assert_array_equal(final_obs[..., 13:16], goal_before)
    assert np.all(np.any(goal[ended] != goal_before[ended], axis=-1))
    assert np.all(goal[~ended] == goal_before[~ended])
    np.testing.assert_allclose(obs[ended][:, 0], 0.0, atol=1e-6)  # back at the start
    assert np.all(final_obs[ended][:, 0] > 1e-3)  # where it had driven to


@pytest.mark.slow
def test_each_environment_can_have_a_physics_model_of_its_own():
    env = make_env(parse_config({}))
    slopes = jnp.array([0.5, 1.0])

    def randomize(model):
        axes = jax.tree.map(lambda _: None, model)
        gains = model.actuator_gainprm[None] * slopes[:, None, None]
        biases = model.actuator_biasprm[None] * slopes[:, None, None]
        batch = model.replace(actuator_gainprm=gains, actuator_biasprm=biases)
        return batch, axes.replace(actuator_gainprm=0, actuator_biasprm=0)

    batch = wrap_for_training(env, 256, randomization_fn=randomize)
    state = batch.reset(jnp.zeros((2, 2), jnp.uint32))
    assert batch.step_packed.kernel(pack(state, batch_axes=1)) is None
    step = jax.jit(batch.step)
    for _ in range(3):
        state = step(state, jnp.array([[-0.9, 0.0]] * 2))
    weak, strong = state.pipeline_state.qpos[:, 0]
    assert 0 < weak < 0.8 * strong
    # And none of them is the environment's own, which stays as it was.
    fresh = mjx.put_model(make_mj_model(env.robot, env.config.physics, visual=False))
    np.testing.assert_array_equal(env.mjx_model.actuator_gainprm, fresh.actuator_gainprm)


def test_no_back_end_is_tried_before_a_step_is_traced(monkeypatch):
    # A program from the cache needs none, and a GPU's takes 0.3 s.
    asked = []

    def none_yet():
        asked.append(True)
        return "there is none"

    for backend in BACKENDS:
        monkeypatch.setattr(backend, "obstacle", none_yet)
    batch = wrap_for_training(make_env(parse_config({})), 256)
    assert not asked
    batch.reset(jnp.zeros((2, 2), jnp.uint32))
    assert asked
