"""Robustness sweeps: their parameters, their one program, and their metrics."""

import json

import jax
import numpy as np
import pytest

from helpers import gliding
from helpers.further import slow_fixture
from jetbot_mjx.agents.networks import PolicyParams, make_networks
from jetbot_mjx.config import LookParams, PPOConfig, RobotParams, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.domain_randomization import LARGEST_TRACED, DomainRandomizationWrapper
from jetbot_mjx.evaluation import robustness
from jetbot_mjx.evaluation.evaluator import Summary, report_keys, wilson_interval
from jetbot_mjx.evaluation.plots import plot_robustness
from jetbot_mjx.evaluation.robustness import (
    SWEEPS,
    Sweep,
    Sweeper,
    SweepResult,
    as_json,
    robust_range,
)
from jetbot_mjx.runs import Setup

EPISODES = 16


def summary(rate, episodes=100):
    wins = round(rate * episodes)
    low, high = wilson_interval(wins, episodes)
    seconds = 1.5 if wins else None
    return Summary(episodes, wins, rate, low, high, seconds, seconds, 0.9 * bool(wins), 0, 0, 0)


def result(policy, values=(0.4, 0.6, 1.0, 1.2)):
    one = Sweep("friction", "wheel-floor friction", "× preset", values, "here")
    return SweepResult(
        one, tuple(summary(rate) for rate in policy), tuple(summary(1.0) for _ in policy)
    )


def test_every_difference_is_swept_around_the_presets_value():
    assert tuple(one.name for one in SWEEPS) == RobotParams._fields + LookParams._fields
    for one in SWEEPS:
        assert one.nominal in one.values
        assert list(one.values) == sorted(set(one.values))
        assert one.label
        assert one.unit
        assert one.source
    by_name = {one.name: max(one.values) for one in SWEEPS}
    assert {name: by_name[name] for name in LARGEST_TRACED} == LARGEST_TRACED


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        ((1.0, 1.0, 1.0, 1.0), (0.4, 1.2)),
        ((0.2, 0.95, 1.0, 0.94), (0.6, 1.0)),
        ((1.0, 0.9, 1.0, 1.0), (1.0, 1.2)),  # what lies beyond a gap does not count
        ((1.0, 1.0, 0.94, 1.0), None),
    ],
)
def test_a_policy_carries_from_the_presets_value_to_the_first_failure(policy, expected):
    assert robust_range(result(policy)) == expected


def test_the_results_are_plain_values():
    told = json.loads(json.dumps(as_json([result((0.0, 0.95, 1.0, 0.94))]), allow_nan=False))
    (quantity,) = told["quantities"]
    assert quantity["name"] == "friction"
    assert quantity["values"] == [0.4, 0.6, 1.0, 1.2]
    assert (quantity["nominal"], quantity["carries"]) == (1.0, [0.6, 1.0])
    assert [one["success_rate"] for one in quantity["policy"]] == [0.0, 0.95, 1.0, 0.94]
    assert quantity["policy"][0]["time_to_goal_median"] is None
    assert [one["success_rate"] for one in quantity["scripted"]] == [1.0] * 4


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_figure_shows_success_its_band_and_the_presets_value(count):
    results = [result((0.0, 0.95, 1.0, 0.94))] * count
    figure = plot_robustness(results)
    figure.canvas.draw()
    assert len(figure.axes) == 2 * count
    success, time = figure.axes[:2]
    assert success.get_title() == "wheel-floor friction"
    assert time.get_xlabel() == "[× preset]"
    lines = {line.get_label(): line for line in success.lines}
    np.testing.assert_allclose(lines["policy"].get_ydata(), (0.0, 0.95, 1.0, 0.94))
    assert [1.0, 1.0] in [list(line.get_xdata()) for line in success.lines]
    band = success.collections[1].get_paths()[0].vertices[:, 1]
    ends = [(one.success_low, one.success_high) for one in results[0].policy]
    assert set(np.ravel(ends)) <= set(band)
    np.testing.assert_array_equal(np.isnan(time.lines[1].get_ydata()), [True, False, False, False])


class Counted(DomainRandomizationWrapper):
    """Counts how often a robot is built, which is once for each trace."""

    built = 0

    def __init__(self, env, robot_params, **looks):
        type(self).built += 1
        super().__init__(env, robot_params, **looks)


@slow_fixture(scope="module")
def swept():
    """An untrained policy over two quantities, and how often the program was traced."""
    env = make_env(parse_config({"task": {"observation": "egocentric"}}))
    ppo = PPOConfig(normalize_observations=False)
    networks = make_networks(ppo, env.observation_size, env.action_size)
    key = jax.random.PRNGKey(0)
    params = PolicyParams(None, networks.policy_network.init(key), None)
    values = {"motor_gain": (0.2, 1.0), "action_delay": (0.0, 9.0)}
    sweeps = [one._replace(values=values[one.name]) for one in SWEEPS if one.name in values]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robustness, "DomainRandomizationWrapper", Counted)
        results = Sweeper(
            Setup(env.config, env=env, networks=networks), report_keys(EPISODES), sweeps
        ).run(params)
    return env, results


@pytest.mark.slow
def test_one_program_serves_every_robot_and_controller(swept):
    assert Counted.built == 1


def test_every_value_has_its_figures_on_the_same_goals(swept):
    _, (gain, delay) = swept
    for one in (gain, delay):
        assert len(one.policy) == len(one.scripted) == 2
        assert {each.episodes for each in (*one.policy, *one.scripted)} == {EPISODES}
    # The preset's robot is the same in every sweep.
    assert gain.scripted[1] == delay.scripted[0]
    assert gain.policy[1] == delay.policy[0]
    assert gain.policy[1] != gain.scripted[1]


def test_a_weak_robot_and_a_slow_answer_cost_success(swept):
    _, (gain, delay) = swept
    assert gain.scripted[1].success_rate == 1.0
    assert gain.scripted[0].success_rate < 0.5  # 0.2 m/s do not last for the way
    assert delay.scripted[1].success_rate < 0.8


@slow_fixture(scope="module")
def swept_looks():
    """An untrained policy that sees, on a gliding robot: what it did under which looks."""
    camera = {"width": 16, "height": 16, "samples": 1}
    task = {"observation": "camera", "episode_length": 12}
    network = {"cnn": "tiny", "policy_hidden_layer_sizes": [4], "value_hidden_layer_sizes": [4]}
    ppo = {"network": network, "normalize_observations": False}
    config = parse_config({"task": task, "camera": camera, "ppo": ppo})
    env = make_env(config)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    key = jax.random.PRNGKey(0)
    params = PolicyParams(None, networks.policy_network.init(key), None)
    values = {"motor_gain": (0.5, 1.0), "exposure": (0.0, 1.0), "camera_delay": (0.0, 9.0)}
    sweeps = [one._replace(values=values[one.name]) for one in SWEEPS if one.name in values]
    with gliding.everywhere():
        return Sweeper(
            Setup(env.config, env=env, networks=networks), report_keys(EPISODES), sweeps
        ).run(params)


@pytest.mark.slow
def test_looks_are_swept_for_a_policy_that_sees(swept_looks):
    gain, exposure, delay = swept_looks
    assert [one.sweep.name for one in swept_looks] == ["motor_gain", "exposure", "camera_delay"]
    assert exposure.policy[1] == delay.policy[0] == gain.policy[1]
    assert exposure.policy[0].episode_return != exposure.policy[1].episode_return
    assert delay.policy[1].episode_return != delay.policy[0].episode_return


def test_the_scripted_controller_does_not_see_the_looks(swept_looks):
    gain, exposure, delay = swept_looks
    assert {*exposure.scripted, *delay.scripted} == {gain.scripted[1]}


def test_a_policy_that_does_not_see_is_swept_without_looks():
    env = make_env(parse_config({"task": {"observation": "egocentric"}}))
    networks = make_networks(env.config.ppo, env.observation_size, env.action_size)
    sweeper = Sweeper(Setup(env.config, env=env, networks=networks), report_keys(1))
    assert tuple(one.name for one in sweeper._sweeps) == RobotParams._fields
