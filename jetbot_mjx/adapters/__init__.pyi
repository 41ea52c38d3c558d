from .gymnasium import JetBotGymEnv as JetBotGymEnv
from .vector import JetBotVectorEnv as JetBotVectorEnv
