"""Train policies with Brax's networks and PPO, as pure functions of one training state."""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.agents.networks import make_networks as make_networks
    from jetbot_mjx.agents.networks import make_policy as make_policy
    from jetbot_mjx.agents.ppo import PPO as PPO

__getattr__, __dir__ = load_lazily(__name__)
