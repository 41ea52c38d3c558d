"""A configuration becomes the robot with its task, or an environment of one's own."""

import pytest

from helpers.own_environments import NoisyPoint
from jetbot_mjx.config import ConfigError, parse_config
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.task import GoalTask
from jetbot_mjx.errors import UserError

POINT = "helpers.own_environments:NoisyPoint"


def test_a_robot_is_built_where_there_is_no_environment():
    env = make_env("smoke")
    assert type(env) is JetBotEnv
    assert type(env.task) is GoalTask


def test_an_environment_is_built_with_its_options():
    env = make_env(parse_config({"environment": POINT, "environment_options": {"limit": 4}}))
    assert type(env) is AdaptedEnv
    assert (type(env.source), env.source.limit, env.source.edge) == (NoisyPoint, 4, 1.0)


@pytest.mark.parametrize("name", [POINT, "nowhere:Nothing"])
def test_a_class_that_is_given_is_not_imported(name):
    class Other(NoisyPoint):
        pass

    env = make_env(parse_config({"environment": name}), own_class=Other)
    assert type(env.source) is Other


def test_a_task_that_is_given_is_taken():
    class Other(GoalTask):
        pass

    assert type(make_env("smoke", own_class=Other).task) is Other


@pytest.mark.parametrize(
    ("settings", "error", "told"),
    [
        ({"environment": "nowhere:Nothing"}, UserError, "there is no nowhere.py"),
        ({"environment": "helpers.own_environments:jnp"}, UserError, "is no class and no func"),
        (
            {"environment": POINT, "environment_options": {"limits": 4}},
            UserError,
            "NoisyPoint raises TypeError: .* unexpected keyword argument 'limits'",
        ),
        ({"environment": 3}, ConfigError, "environment = 3"),
    ],
)
def test_what_cannot_be_built_is_refused(settings, error, told):
    with pytest.raises(error, match=told):
        make_env(parse_config(settings))
