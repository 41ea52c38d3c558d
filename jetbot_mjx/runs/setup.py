"""Build what a configuration describes: environment, networks, programs."""

import functools

from jetbot_mjx import envs
from jetbot_mjx.agents import Networks, make_networks
from jetbot_mjx.config import Config
from jetbot_mjx.envs import JetBotEnv
from onekernel import ProgramCache


class Setup:
    """A `Setup` holds what a configuration describes, each built once, at its first use."""

    def __init__(
        self,
        config: Config,
        programs: ProgramCache | None = None,
        *,
        env: JetBotEnv | None = None,
        task_class: type[envs.Task] | None = None,
        networks: Networks | None = None,
    ) -> None:
        """Describe what to build; what is given is not built again.

        Args:
          config: the configuration.
          programs: the cache of its compiled programs; None: one in memory.
          env: its environment, unwrapped; None: it is built.
          task_class: the class of the task of the environment that is built; None: the one that
            `task.name` imports.
          networks: networks that fit the environment; None: they are built.
        """
        self.config = config
        self.programs = programs or envs.open_program_cache(config, keep=False)
        """The cache of compiled programs, which has the compiler's options."""
        self._env, self._task_class, self._networks = env, task_class, networks

    @functools.cached_property
    def env(self) -> JetBotEnv:
        """Return the environment, unbatched and unwrapped.

        Raises:
          UserError: the task or its scene cannot be built.
        """
        return self._env or envs.make_env(self.config, task_class=self._task_class)

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
