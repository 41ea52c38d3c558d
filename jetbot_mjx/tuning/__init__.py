"""Search for hyperparameters, with many trials side by side in one compiled program."""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.tuning.results import TuningResult as TuningResult
    from jetbot_mjx.tuning.results import run_search as run_search
    from jetbot_mjx.tuning.search import Search as Search
    from jetbot_mjx.tuning.space import Parameter as Parameter
    from jetbot_mjx.tuning.space import read_space as read_space
    from jetbot_mjx.tuning.trials import Trials as Trials

__getattr__, __dir__ = load_lazily(__name__)
