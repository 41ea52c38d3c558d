"""Import the parts of Brax that every training needs, after MJX.

Brax imports MJX, of whose lines `mjx_import` drops those that nobody needs.
"""

from jetbot_mjx.mjx_import import Env as Env

# isort: split
from brax.training.acme import running_statistics
from brax.training.acme import specs as specs
from brax.training.agents.ppo import optimizer as optimizer
from brax.training.types import Transition as Transition
from brax.training.types import UInt64 as UInt64
from brax.training.types import (
    identity_observation_preprocessor as identity_observation_preprocessor,
)

Normalizer = running_statistics.RunningStatisticsState
"""The statistics that normalise observations, of a vector or of its parts by name."""
