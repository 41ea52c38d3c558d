"""The modules of the commands whose names the package gives to its functions.

`from jetbot_mjx import train` imports the function, `from helpers.command_modules import train` the
module.
"""

import importlib
from pathlib import Path

from jetbot_mjx import plan, replay

evaluate = importlib.import_module("jetbot_mjx.evaluate")
render = importlib.import_module("jetbot_mjx.render")
train = importlib.import_module("jetbot_mjx.train")
tune = importlib.import_module("jetbot_mjx.tune")

COMMANDS = {
    "plan": plan,
    "train": train,
    "evaluate": evaluate,
    "render": render,
    "replay": replay,
}
"""Commands that read a configuration or a run, by their names."""

SMOKE = str(Path(__file__).parents[2] / "configs" / "smoke.yaml")
