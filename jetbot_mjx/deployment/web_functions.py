"""Write all functions of a page's WebAssembly module: robots, policies, and their training."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jetbot_mjx.agents import WebLearner, network_texts, web_learner
from jetbot_mjx.config import Config
from jetbot_mjx.deployment.web_env import WebEnv, web_env, web_training_env
from jetbot_mjx.deployment.web_scene import WebScene, web_scene
from jetbot_mjx.envs import JetBotEnv


class WebFunctions(NamedTuple):
    """A `WebFunctions` holds the functions of a module, and what a script must know of them."""

    texts: Mapping[str, str]
    """All functions as LLVM modules, by name."""
    scene: WebScene
    robots: WebEnv
    """The robots that the page shows."""
    training: WebEnv
    """Those of a training."""
    learner: WebLearner | str
    """What updates the networks, or why a page cannot."""


def web_functions(config: Config, env: JetBotEnv) -> WebFunctions:
    """Write the functions of a configuration.

    Args:
      config: the configuration.
      env: its environment, unwrapped.

    Raises:
      UnsupportedError: a function cannot be one kernel.
    """
    scene = web_scene(env.mj_model)
    robots = training = web_env(env, scene.bodies)
    texts = {**robots.texts, **network_texts(config.ppo.network.activation)}
    learner = web_learner(config.ppo, env.observation_size, env.action_size)
    if isinstance(learner, str):
        return WebFunctions(texts, scene, robots, training, learner)
    # Deviations of the observation have a floor, as in `PPO`.
    size = learner.about["shape"]["observations"]
    smallest = np.asarray(env.observation_min_std if config.ppo.normalizer == "physical" else 0.0)
    about = {**learner.about, "smallest_deviations": np.broadcast_to(smallest, size).tolist()}
    # A page shows the robot as its preset is; in a training, robots may differ.
    if config.randomization.drawn:
        training = web_training_env(env)
    texts = {**texts, **training.texts, **learner.texts}
    return WebFunctions(texts, scene, robots, training, learner._replace(about=about))
