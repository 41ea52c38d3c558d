from .results import TuningResult as TuningResult
from .results import entrants_table as entrants_table
from .results import run_search as run_search
from .search import CONFIRM_SEEDS as CONFIRM_SEEDS
from .search import Search as Search
from .space import read_space as read_space
from .trials import Objective as Objective
