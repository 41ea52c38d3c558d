"""Simulate one JetBot and its task as a `brax.envs.Env`: robot, task, physics and wrappers.

Everything is pure and unbatched: batch with `jax.vmap`, outermost.
"""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.envs.domain_randomization import (
        DomainRandomizationWrapper as DomainRandomizationWrapper,
    )
    from jetbot_mjx.envs.jetbot_env import JetBotEnv as JetBotEnv
    from jetbot_mjx.envs.jetbot_env import make_env as make_env
    from jetbot_mjx.envs.state import State as State
    from jetbot_mjx.envs.task import GoalTask as GoalTask
    from jetbot_mjx.envs.task import RobotState as RobotState
    from jetbot_mjx.envs.task import Task as Task
    from jetbot_mjx.envs.task_template import write_task_template as write_task_template
    from jetbot_mjx.envs.wrappers import wrap_for_training as wrap_for_training

__getattr__, __dir__ = load_lazily(__name__)
