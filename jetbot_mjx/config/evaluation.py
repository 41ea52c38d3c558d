"""Define the section `evaluation`: the evaluations during training."""

from typing import Literal

from jetbot_mjx.config.section import Section
from jetbot_mjx.config.value_types import Count


class EvaluationConfig(Section):
    """The evaluations during training; `jetbot-mjx evaluate` has its own arguments."""

    episodes: Count = 256
    """Deterministic episodes per evaluation, on other goals than those of the report."""
    video: Literal[False, True, "last"] = False
    """Whether every evaluation, or only that at the end of the training (`last`), also renders the
    first four goals of the report, into `videos/<env_steps>/`, TensorBoard and Weights & Biases.
    Without OpenGL a line says so, and the training continues."""
