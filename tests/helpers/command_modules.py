"""The modules of the commands whose names the package gives to its functions.

`from jetbot_mjx import train` imports the function; `from command_modules import train` the module.
"""

import importlib

evaluate = importlib.import_module("jetbot_mjx.evaluate")
render = importlib.import_module("jetbot_mjx.render")
train = importlib.import_module("jetbot_mjx.train")
