"""A configuration describes a robot with its task, or an environment of one's own."""

import pytest

from helpers import own_environments
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.errors import UserError


def own(**options):
    name = "helpers.own_environments:Point"
    return parse_config({"environment": name, "environment_options": options})


def test_a_robot_with_its_task_is_built():
    assert type(make_env("smoke")) is JetBotEnv


def test_an_environment_is_built_with_its_options():
    env = make_env(own(start=1.0), {"environment_options.start": 2.5})
    assert isinstance(env, AdaptedEnv)
    assert env.source.start == 2.5
    assert repr(env) == (
        "AdaptedEnv('helpers.own_environments:Point', observation_size=2, action_size=1)"
    )


def test_a_class_that_was_imported_before_is_used():
    class Mine(own_environments.Point):
        pass

    assert type(make_env(own(), own_class=Mine).source) is Mine


def test_a_misspelt_option_is_told():
    with pytest.raises(UserError, match=r"Point raises TypeError: .*'strat'"):
        make_env(own(strat=2.5))
