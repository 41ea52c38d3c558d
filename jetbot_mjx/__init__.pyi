__version__: str

from .config import load_config as load_config
from .envs import GoalTask as GoalTask
from .envs import JetBotEnv as JetBotEnv
from .envs import State as State
from .envs import Task as Task
from .envs import make_env as make_env
from .envs import wrap_for_training as wrap_for_training
from .library import evaluate as evaluate
from .library import load_policy as load_policy
from .library import render as render
from .library import train as train
from .library import tune as tune
from .runs import PRETRAINED as PRETRAINED
