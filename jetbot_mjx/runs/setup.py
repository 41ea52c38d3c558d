"""Build what a configuration describes: environment, networks, programs."""

import functools

from jetbot_mjx import envs
from jetbot_mjx.agents import Networks, make_networks
from jetbot_mjx.config import Config
from jetbot_mjx.envs import AdaptedEnv, JetBotEnv
from jetbot_mjx.errors import UserError
from onekernel import ProgramCache


class Setup:
    """A `Setup` holds what a configuration describes, each built once, at its first use."""

    def __init__(
        self,
        config: Config,
        programs: ProgramCache | None = None,
        *,
        env: JetBotEnv | AdaptedEnv | None = None,
        own_class: type | None = None,
        networks: Networks | None = None,
    ) -> None:
        """Describe what to build; what is given is not built again.

        Args:
          config: the configuration.
          programs: the cache of its compiled programs; None: one in memory.
          env: its environment, unwrapped; None: it is built.
          own_class: the class of its task, or of an environment of one's own; None: the one that
            `task.name` or `environment` imports.
          networks: networks that fit the environment; None: they are built.
        """
        self.config = config
        self.programs = programs or envs.open_program_cache(config, keep=False)
        """The cache of compiled programs, which has the compiler's options."""
        self._env, self._own_class, self._networks = env, own_class, networks

    @functools.cached_property
    def env(self) -> JetBotEnv | AdaptedEnv:
        """Return the environment, unbatched and unwrapped.

        Raises:
          UserError: the environment, or the task or its scene, cannot be built.
        """
        return self._env or envs.make_env(self.config, own_class=self._own_class)

    @property
    def robot_env(self) -> JetBotEnv:
        """Return the environment of a robot and its task.

        Raises:
          UserError: the configuration has an `environment` of one's own.
        """
        if isinstance(self.env, AdaptedEnv):
            raise UserError(
                f"environment = {self.config.environment!r} has no robot that drives to a goal:"
                " this is for policies of `task` only"
            )
        return self.env

    @functools.cached_property
    def training_env(self) -> envs.BatchWrapper:
        """Return the environment in the wrappers of a training, batched."""
        return envs.wrap_for_training(self.env, self.config.task.episode_length)

    @functools.cached_property
    def networks(self) -> Networks:
        """Return the networks of policy and value function.

        Raises:
          UserError: they do not fit the environment's observations or actions.
        """
        return self._networks or make_networks(
            self.config.ppo, self.env.observation_size, self.env.action_size
        )
