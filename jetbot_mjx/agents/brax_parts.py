"""Import the parts of Brax that every training needs, after MJX.

Brax imports MJX, of whose lines `mjx_import` drops those that nobody needs.
"""

from jetbot_mjx.mjx_import import Env

# isort: split
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import optimizer
from brax.training.types import Transition, UInt64, identity_observation_preprocessor

Normalizer = running_statistics.RunningStatisticsState
"""The statistics that normalise observations, of a vector or of its parts by name."""

__all__ = [
    "Env",
    "Normalizer",
    "Transition",
    "UInt64",
    "identity_observation_preprocessor",
    "optimizer",
    "running_statistics",
    "specs",
]
