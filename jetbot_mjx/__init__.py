"""A JetBot that learns to drive to goals, thousands at a time: MuJoCo MJX and Brax's PPO.

The modules in reading order, each knowing only those before it:
`errors`, `interrupts`, `config`, `trusted_files`, `compiling`, `imports`, `mjx`, `cholesky`,
`scalars`, `moving`, `schedule`, `scalarize`, `kernel`, `llvm`, `gpu`, `xla_ffi`, `cpu`,
`kinematics`, `model`, `task`, `programs`, `state`, `physics`, `env`, `mujoco_jetbot`, `variation`,
`motors`, `sensors`, `randomization`, `mujoco_simulator`, `wrappers`, `task_trials`,
`method_checks`, `task_checks`, `policy`, `advantages`, `ppo`, `trainer`, `rollout`, `evaluation`,
`robustness`, `best_known`, `report`, `estimates`, `comparison`, `tables`, `plots`, `curves`,
`offscreen`, `film`, `store`, `checkpoint`, `resume`, `faults`, `run_folder`, `aliases`, `metrics`,
`report_files`, `tracking`, `terminal`, `board`, `dashboard`, `recording`, `preemption`,
`processes`, `memory`, `resumable_ppo`, `brax_ppo`, `training`, `portable`, `contract`, `formats`,
`stand_in`, `drive_log`, `clock`, `live`, `player`, `geoms`, `scene`, `panel`, `browser`, `native`,
`cli`, and the commands `new_task`, `check_env`, `plan`, `train`, `evaluate`, `render`, `replay`,
`play`, `export`, `sim2real`, `pretrained`, `__main__`. Commands meet only in the run folder. Beside
them stand the adapters, for programs of Gymnasium and Stable-Baselines3; none but they import
those, and no other module imports an adapter.

What the package itself offers is imported at its first use: a command that is mistyped says so at
once, and a GPU wakes while the rest loads.
"""

import importlib
from typing import TYPE_CHECKING, Any

from jetbot_mjx.imports import lighten as _lighten
from jetbot_mjx.interrupts import leave_at_once as _leave_at_once

if TYPE_CHECKING:
    from jetbot_mjx.checkpoint import PRETRAINED as PRETRAINED
    from jetbot_mjx.checkpoint import load_policy as load_policy
    from jetbot_mjx.config import load_config as load_config
    from jetbot_mjx.env import JetBotEnv as JetBotEnv
    from jetbot_mjx.env import make_env as make_env
    from jetbot_mjx.state import State as State
    from jetbot_mjx.task import GoalTask as GoalTask
    from jetbot_mjx.task import Task as Task
    from jetbot_mjx.wrappers import wrap_for_training as wrap_for_training

_HOMES = {
    "GoalTask": "task",
    "PRETRAINED": "checkpoint",
    "JetBotEnv": "env",
    "State": "state",
    "Task": "task",
    "load_config": "config",
    "load_policy": "checkpoint",
    "make_env": "env",
    "wrap_for_training": "wrappers",
}
"""Public names, and the modules they live in: configurations name tasks by the former alone."""

_leave_at_once()
_lighten()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
