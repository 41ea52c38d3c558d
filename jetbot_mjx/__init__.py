"""A JetBot that learns to drive to goals, thousands at a time: MuJoCo MJX and Brax's PPO.

The modules in reading order, each knowing only those before it:
`errors`, `config`, `compiling`, `imports`, `mjx`, `cholesky`, `scalars`, `scalarize`, `ptx`,
`kernel`, `kinematics`, `model`, `task`, `state`, `physics`, `env`, `variation`, `wrappers`,
`policy`, `advantages`, `ppo`, `trainer`, `rollout`, `evaluation`, `robustness`, `report`,
`estimates`, `comparison`, `tables`, `plots`, `curves`, `offscreen`, `film`, `store`, `checkpoint`,
`resume`, `faults`, `run_folder`, `aliases`, `metrics`, `report_files`, `tracking`, `terminal`,
`board`, `dashboard`, `recording`, `preemption`, `processes`, `memory`, `resumable_ppo`, `brax_ppo`,
`clock`, `live`, `player`, `geoms`, `scene`, `panel`, `browser`, `native`, `cli`, and the commands
`plan`, `train`, `evaluate`, `render`, `replay`, `play`. Commands meet only in the run folder.
"""

# First, before Brax imports MJX and lets it print.
from jetbot_mjx import mjx as _mjx  # isort: skip

from jetbot_mjx.checkpoint import load_policy as load_policy
from jetbot_mjx.config import load_config as load_config
from jetbot_mjx.env import JetBotEnv as JetBotEnv
from jetbot_mjx.env import make_env as make_env
from jetbot_mjx.state import State as State
from jetbot_mjx.task import Task as Task
from jetbot_mjx.wrappers import wrap_for_training as wrap_for_training

del _mjx
