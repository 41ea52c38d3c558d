"""Train a JetBot to drive to goals, thousands at a time: MuJoCo MJX and Brax's PPO.

The subpackages, each of which imports only from those before it:

- `config`: the settings of a run, and the table of all that may be randomised
- `terminal`: progress and tables of the commands
- `envs`: robot, task, physics, episodes
- `agents`: networks and PPO
- `runs`: what a run folder holds
- `evaluation`: scores, comparisons, reports
- `viewers`: videos, browser, window
- `training`: from a configuration to a finished run
- `tuning`: search for hyperparameters
- `deployment`: a policy without JAX
- `adapters`: Gymnasium and Stable-Baselines3, for other people's programs
- `startup`: how a command prepares its process, so that it starts sooner

The root holds the modules that all subpackages use (such as `errors`), the functions for other
programs (`library`), and the commands, which share only the run folder: `jetbot-mjx` lists them. A
public name is imported at its first use, so that a mistyped command fails at once and a GPU
initialises while the rest is imported.
"""

import sys
from types import ModuleType

import lazy_loader

__version__ = "0.1.0"

# The stub lists the public names. Configurations and runs refer to `jetbot_mjx:GoalTask`.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


class _Package(ModuleType):
    """The type of this package, whose public functions stay functions.

    `python -m jetbot_mjx.train` needs a module of that name, and when a module is imported, Python
    sets it as an attribute of its package. Without this class `jetbot_mjx.train` would be the
    function or the module of the command, depending on what the program imported first.
    """

    def __setattr__(self, name: str, value: object) -> None:
        """Set an attribute, unless a module would take the place of a public name."""
        if not (isinstance(value, ModuleType) and name in ("train", "evaluate", "render", "tune")):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
