"""Stable-Baselines3's PPO on the JetBot, with the tutorial's hyperparameters.

    pip install '.[sb3,tensorboard]'
    python examples/sb3_train.py                          # one robot, as in the tutorial
    python examples/sb3_train.py --num-envs 32            # 32 robots in one program
    python examples/sb3_train.py --camera                 # `CnnPolicy`, from images

To run a script that follows the tutorial, change its import of the environment:

    from jetbot_mjx.adapters import JetBotGymEnv as JetBotEnv
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jetbot_mjx import cli
from jetbot_mjx.errors import requires_extra

if TYPE_CHECKING:
    from gymnasium import Env
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv

_STEPS = 2560
"""Environment steps between two updates, over all robots."""

_CAMERA = {"task": {"observation": "camera"}, "camera": {"width": 64, "height": 64}}


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and save the policy.

    Args:
      arguments: Arguments without the program's name; None: those of the process.

    Returns:
      The exit code.

    Raises:
      MissingPackageError: Stable-Baselines3 is not installed.
    """
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=cli.positive_int, default=500_000, help="default: 500000")
    parser.add_argument(
        "--num-envs", type=cli.whole_number(1, _STEPS), default=1, help="default: 1"
    )
    parser.add_argument(
        "--camera", action="store_true", help="images instead of numbers, 64 x 64 pixels"
    )
    parser.add_argument("--folder", type=Path, default=Path("sb3_policy"))
    options = parser.parse_args(arguments)
    with requires_extra("sb3", parser.prog):
        from stable_baselines3.common.callbacks import CheckpointCallback
        from stable_baselines3.common.vec_env import VecMonitor

    from jetbot_mjx.adapters import JetBotGymEnv
    from jetbot_mjx.adapters.stable_baselines3 import JetBotVecEnv

    config = _CAMERA if options.camera else None
    if options.num_envs == 1:
        env = JetBotGymEnv(config=config)
    else:
        robots = JetBotVecEnv(options.num_envs, config=config)
        env = VecMonitor(robots, info_keywords=("is_success",))
    ppo = _ppo(env, options)
    # `CheckpointCallback` counts calls of `step`, each of which steps all robots.
    every = CheckpointCallback(max(1, 10_000 // options.num_envs), str(options.folder), "jetbot")
    ppo.learn(options.steps, callback=every)
    ppo.save(options.folder / "jetbot")
    env.close()
    return 0


def _ppo(env: Env | VecEnv, options: argparse.Namespace) -> PPO:
    """Return PPO before its first step, with the tutorial's hyperparameters."""
    import torch
    from stable_baselines3 import PPO

    # More threads do not speed up networks of this size, and slow down on a busy machine.
    torch.set_num_threads(1)
    layers = {"pi": [16, 128, 128, 128], "vf": [16, 128, 128, 128]}
    return PPO(
        "CnnPolicy" if options.camera else "MlpPolicy",
        env,
        n_steps=_STEPS // options.num_envs,
        batch_size=64,
        n_epochs=5,
        learning_rate=1.25e-4,
        gamma=0.9,
        gae_lambda=1.0,
        clip_range=0.3,
        ent_coef=7.5e-8,
        vf_coef=0.95,
        max_grad_norm=0.9,
        policy_kwargs=None
        if options.camera
        else {"activation_fn": torch.nn.Tanh, "net_arch": layers},
        tensorboard_log=str(options.folder) if importlib.util.find_spec("tensorboard") else None,
        device="cpu",  # a network of this size is slower on a GPU
        seed=0,
        verbose=1,
    )


if __name__ == "__main__":
    cli.run_command(main)
