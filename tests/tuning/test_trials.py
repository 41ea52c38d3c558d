"""Trials trained side by side are the same as trained alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from helpers.stages import noted_stages
from jetbot_mjx.config import parse_config
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.tuning.space import with_values
from jetbot_mjx.tuning.trials import Trials

CONFIG = parse_config(
    {
        "task": {"observation": "egocentric", "episode_length": 40},
        "ppo": {
            "num_timesteps": 1024,
            "num_envs": 16,
            "unroll_length": 8,
            "batch_size": 16,
            "num_minibatches": 4,
            "network": {"policy_hidden_layer_sizes": [16], "value_hidden_layer_sizes": [16]},
        },
        "evaluation": {"episodes": 8},
    }
)
NAMES = ("ppo.learning_rate", "ppo.discounting")
VALUES = (
    {"ppo.learning_rate": 1e-3, "ppo.discounting": 0.95},
    {"ppo.learning_rate": 1e-2, "ppo.discounting": 0.9},
    {"ppo.learning_rate": 1e-3, "ppo.discounting": 0.95},
)


@pytest.fixture(scope="module", autouse=True)
def glide():
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
def trials():
    return Trials(CONFIG, NAMES, evaluations=2)


@pytest.fixture(scope="module")
def outcomes(trials):
    return trials.run(VALUES, [3, 3, 4])


def leaves(params):
    return [np.asarray(x) for x in jax.tree.leaves(params)]


def test_a_trial_is_the_training_that_its_values_give(trials, outcomes):
    # The same training with the values as constants of the program.
    from jetbot_mjx.agents.ppo import PPO
    from jetbot_mjx.envs.build import make_env
    from jetbot_mjx.envs.wrappers import wrap_for_training

    config = with_values(CONFIG, VALUES[1], source="it")
    ppo = PPO(
        config.ppo,
        wrap_for_training(make_env(config), config.task.episode_length),
        trials._networks,
    )

    @jax.jit
    def train(key):
        steps = jnp.asarray(config.ppo.training_steps, jnp.int32)
        return ppo.unpacked(ppo.advance(ppo.packed(ppo.init(key)), steps, jnp.ones((), bool))[0])

    alone = train(jax.random.PRNGKey(3)).policy_params
    for ours, theirs in zip(leaves(outcomes[1].params), leaves(alone), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=2e-3, atol=2e-4)


def test_values_and_seeds_make_a_difference(outcomes):
    first, other_values, other_seed = (leaves(one.params) for one in outcomes)
    for other in (other_values, other_seed):
        assert any(not np.array_equal(a, b) for a, b in zip(first, other, strict=True))


def test_a_trial_does_not_depend_on_its_neighbours(trials, outcomes):
    again = trials.run([VALUES[1], VALUES[0], VALUES[1]], [9, 3, 9])
    for ours, theirs in zip(leaves(outcomes[0].params), leaves(again[1].params), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_outcomes_are_measured(trials, outcomes):
    for one in outcomes:
        assert len(one.scores) == 2
        assert one.value("learning") == pytest.approx(np.mean(one.scores))
        assert one.value("time") == one.mean_seconds
        assert 0 < one.mean_seconds <= 40 / 60 + 1e-6
    stacked = jax.tree.map(lambda *x: np.stack(x), *(one.params for one in outcomes))
    assert trials.evaluate(stacked, report_keys(5)).success.shape == (3, 5)


def test_a_trial_that_is_ended_leaves_the_others_as_they_were(trials, outcomes):
    asked = []

    def goes_on(trial, outcome):
        asked.append((trial, outcome.scores, outcome.params))
        return trial == 1

    with noted_stages() as shown:
        ended, kept, other = trials.run(VALUES, [3, 3, 4], goes_on)
    assert asked == [(i, outcomes[i].scores[:1], None) for i in range(3)]
    assert (ended.scores, ended.params) == (outcomes[0].scores[:1], None)
    assert (other.scores, other.params) == (outcomes[2].scores[:1], None)
    # One of four rows goes on, alone, by a program of its own.
    assert kept.scores == outcomes[1].scores
    for ours, theirs in zip(leaves(kept.params), leaves(outcomes[1].params), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4)
    assert shown[0] == "compiling the training of up to 4 policies"
    first = trials.run(VALUES, [3, 3, 4], lambda trial, outcome: False)
    assert [one.scores for one in first] == [one.scores[:1] for one in outcomes]


def test_compiling_and_training_are_stages_that_a_command_shows(trials):
    with noted_stages() as shown:
        trials.run(VALUES, [3, 3, 4])
    assert shown == ["compiling the training of up to 4 policies", "training 3 policies, intervals"]


@pytest.mark.slow
def test_trials_begin_with_another_policy(trials, tmp_path):
    from jetbot_mjx.runs.checkpoint import load_checkpoint
    from jetbot_mjx.training import session

    run = CONFIG.model_copy(update={"checkpoint_interval": 1024, "tensorboard": False})
    assert session.run(run, tmp_path / "run").finished
    source = load_checkpoint(tmp_path / "run").params
    config = CONFIG.model_copy(update={"init_from": str(tmp_path / "run")})
    begun = Trials(config, NAMES, evaluations=1)
    traced = {name.removeprefix("ppo."): jnp.full(2, 0.9) for name in NAMES}
    state = begun._begin(traced, jnp.asarray([0, 1], jnp.uint32))
    for ours, theirs in zip(leaves(state.params.value), leaves(source.value), strict=True):
        np.testing.assert_array_equal(ours, np.stack([theirs, theirs]))
    # Environments and noise are those of each seed.
    assert not np.array_equal(*np.asarray(state.key))
    assert len(begun.run(VALUES, [3, 3, 4])) == 3
