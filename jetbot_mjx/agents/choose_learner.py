"""Choose the learner of a configuration, and put XLA in the place of one that cannot be used."""

from jetbot_mjx.agents.brax_parts import Env
from jetbot_mjx.agents.fused.learner import make_fused_learner
from jetbot_mjx.agents.learner import TREES, DeviceAxis, Layout, Learner
from jetbot_mjx.agents.networks import Networks
from jetbot_mjx.agents.xla_learner import XlaLearner
from jetbot_mjx.config import PPOConfig
from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import Fallback, report


def choose_learner(config: PPOConfig, env: Env, networks: Networks, devices: DeviceAxis) -> Learner:
    """Return the learner that `ppo.update` asks for, or XLA's with a report why not.

    Args:
      config: the hyperparameters.
      env: the environment, of which the sizes of observation and action are used.
      networks: the policy and value networks, from `make_networks`.
      devices: the devices over which gradients are averaged.

    Raises:
      UserError: `ppo.update` requests the kernels, and they cannot compute this configuration.
    """
    # XLA where it was asked for.
    if config.update == XlaLearner.name:
        return XlaLearner(config, networks, devices)
    # The kernels where they can compute this configuration, and XLA where not.
    learner = make_fused_learner(config, env.observation_size, env.action_size, devices)
    if isinstance(learner, str):
        return xla_instead(learner, config, networks, devices)
    return learner


def xla_instead(
    reason: str,
    config: PPOConfig,
    networks: Networks,
    devices: DeviceAxis,
    layout: Layout = TREES,
) -> XlaLearner:
    """Return XLA's learner in the place of the kernels', and report why.

    Args:
      reason: why the kernels cannot be used.
      config: the hyperparameters.
      networks: the policy and value networks.
      devices: the devices over which gradients are averaged.
      layout: the form of the states between calls, which stays.

    Raises:
      UserError: `ppo.update` requests the kernels.
    """
    if config.update not in ("auto", XlaLearner.name):
        raise UserError(f"ppo.update = {config.update}: {reason}: choose auto or xla")
    # Report it now, and again whenever a program is loaded that was traced with this learner.
    fallback = Fallback("ppo.update", reason)
    report(fallback)
    return XlaLearner(config, networks, devices, layout, fallback)
