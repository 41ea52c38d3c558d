"""Settings of a training so small that compiling is all that takes time."""

TINY = (
    "checkpoint_interval=1024",
    "task.episode_length=16",
    "ppo.num_timesteps=2048",
    "ppo.num_envs=32",
    "ppo.unroll_length=8",
    "ppo.batch_size=16",
    "ppo.num_minibatches=2",
    "ppo.num_updates_per_batch=1",
    "ppo.network.policy_hidden_layer_sizes=[8]",
    "ppo.network.value_hidden_layer_sizes=[8]",
    "evaluation.episodes=4",
)
