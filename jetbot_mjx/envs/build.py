"""Build the environment that a configuration describes: the robot with its task, or one's own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jetbot_mjx.config import Config, Overrides, load_config
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.jetbot_env import JetBotEnv


def make_env(
    config: str | Path | Config,
    overrides: Overrides = (),
    *,
    own_class: Callable[..., Any] | None = None,
) -> JetBotEnv | AdaptedEnv:
    """Build the environment that a configuration describes.

    Args:
      config: the configuration, its name or its file, as for `load_config`.
      overrides: the settings to change, as for `load_config`.
      own_class: the class of the task or the environment; None: the one that `task.name` or
        `environment` imports.

    Returns:
      The environment, unbatched and unwrapped.

    Raises:
      UserError: the configuration is invalid, or environment, task or scene cannot be built.
    """
    loaded = load_config(config, overrides)
    if loaded.environment is None:
        return JetBotEnv(loaded, own_class)
    return AdaptedEnv(loaded, own_class)
