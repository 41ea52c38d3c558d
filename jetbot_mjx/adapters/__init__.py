"""The environment for Gymnasium and for Stable-Baselines3, each an extra that nothing else needs.

`gymnasium.make("jetbot_mjx.adapters:JetBot-v0")` needs no import: Gymnasium imports what stands
before the colon, and that registers the environment. Stable-Baselines3's batch of robots is
`jetbot_mjx.adapters.stable_baselines3.JetBotVecEnv`.
"""

import contextlib

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Without Gymnasium there is no registry to add the environment to.
with contextlib.suppress(ModuleNotFoundError):
    from gymnasium import register

    register(
        "JetBot-v0",
        entry_point="jetbot_mjx.adapters.gymnasium:JetBotGymEnv",
        vector_entry_point="jetbot_mjx.adapters.vector:JetBotVectorEnv",
    )
