"""The environment for Gymnasium and for Stable-Baselines3, each an extra that nothing else needs.

`gymnasium.make("jetbot_mjx.adapters:JetBot-v0")` needs no import: Gymnasium imports what stands
before the colon, and that registers the environment. Stable-Baselines3's batch of robots is
`jetbot_mjx.adapters.stable_baselines3.JetBotVecEnv`.
"""

from jetbot_mjx.imports import without_warp_lines

with without_warp_lines():
    from jetbot_mjx.adapters.gymnasium import JetBotGymEnv as JetBotGymEnv
    from jetbot_mjx.adapters.vector import JetBotVectorEnv as JetBotVectorEnv
