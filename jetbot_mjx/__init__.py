"""Train a JetBot to drive to goals, thousands at a time: MuJoCo MJX and Brax's PPO.

The subpackages, each of which imports only from those before it:

- `compiler`: one kernel for all robots from a JAX function of one
- `envs`: robot, task, physics, episodes
- `agents`: networks and PPO
- `runs`: what a run folder holds
- `evaluation`: scores, comparisons, reports
- `viewers`: videos, browser, window
- `training`: from a configuration to a finished run
- `tuning`: search for hyperparameters
- `deployment`: a policy without JAX
- `adapters`: Gymnasium and Stable-Baselines3, for other people's programs

The root holds the modules that all subpackages use (`config`, `errors`), the functions for other
programs (`library`), and the commands, which share only the run folder: `jetbot-mjx` lists them. A
public name is imported at its first use, so that a mistyped command fails at once and a GPU
initialises while the rest is imported.
"""

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jetbot_mjx.imports import load_lazily as _load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.config import load_config as load_config
    from jetbot_mjx.envs.jetbot_env import JetBotEnv as JetBotEnv
    from jetbot_mjx.envs.jetbot_env import make_env as make_env
    from jetbot_mjx.envs.state import State as State
    from jetbot_mjx.envs.task import GoalTask as GoalTask
    from jetbot_mjx.envs.task import Task as Task
    from jetbot_mjx.envs.wrappers import wrap_for_training as wrap_for_training
    from jetbot_mjx.library import evaluate as evaluate
    from jetbot_mjx.library import render as render
    from jetbot_mjx.library import train as train
    from jetbot_mjx.library import tune as tune
    from jetbot_mjx.runs.checkpoint import PRETRAINED as PRETRAINED
    from jetbot_mjx.runs.checkpoint import load_policy as load_policy

__version__ = "0.1.0"

# Configurations and runs refer to tasks by these names, independently of the module they are in.
__getattr__, __dir__ = _load_lazily(__name__)


class _Package(ModuleType):
    """The type of this package, whose functions `train`, `evaluate` and `render` stay functions.

    `python -m jetbot_mjx.train` needs a module of that name, and when a module is imported, Python
    sets it as an attribute of its package. Without this class `jetbot_mjx.train` would be the
    function or the module of the command, depending on what the program imported first.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute, unless a module would take the place of a public name."""
        if not (isinstance(value, ModuleType) and name in ("train", "evaluate", "render")):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
