"""Drive PPO from a configuration to a finished run: record it and survive interruptions."""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.training.memory_plan import plan_memory as plan_memory
    from jetbot_mjx.training.session import Result as Result
    from jetbot_mjx.training.session import run as run

__getattr__, __dir__ = load_lazily(__name__)
