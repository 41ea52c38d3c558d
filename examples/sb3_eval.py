"""Show a policy of `sb3_train.py`, and count the goals that it reaches.

It drives to twenty goals in a window; `--headless` opens no window:

    python examples/sb3_eval.py --headless
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jetbot_mjx import cli
from jetbot_mjx.errors import UserError, requires_extra


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive to goals, and print how many were reached.

    Args:
      arguments: Arguments without the program's name; None: those of the process.

    Returns:
      The exit code.

    Raises:
      UserError: There is no policy, no display or no Stable-Baselines3.
    """
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, default=Path("sb3_policy/jetbot.zip"))
    parser.add_argument("--episodes", type=cli.positive_int, default=20, help="default: 20")
    parser.add_argument("--headless", action="store_true", help="do not open a window")
    options = parser.parse_args(arguments)
    with requires_extra("sb3", parser.prog):
        import torch
        from stable_baselines3 import PPO
        from stable_baselines3.common.preprocessing import is_image_space

    from jetbot_mjx.adapters import JetBotGymEnv

    if not options.policy.is_file():
        raise UserError(
            f"--policy {options.policy} does not exist: examples/sb3_train.py saves one"
        )

    torch.set_num_threads(1)
    policy = PPO.load(options.policy, device="cpu")
    config = {}
    space: Any = policy.observation_space
    if is_image_space(space):
        # Stable-Baselines3 puts the channels first.
        _, height, width = space.shape
        config = {"task": {"observation": "camera"}, "camera": {"width": width, "height": height}}
    env = JetBotGymEnv(headless=options.headless, seed=1, config=config)
    reached, lengths = [], []
    for _ in range(options.episodes):
        obs, info = env.reset()
        over, length = False, 0
        while not over:
            action, _ = policy.predict(obs, deterministic=True)
            obs, _, terminated, truncated, info = env.step(action)
            over, length = terminated or truncated, length + 1
        reached.append(info["is_success"])
        lengths.append(length)
    env.close()
    print(f"{sum(reached)} of {len(reached)} goals, {np.mean(lengths):.0f} steps on average")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
