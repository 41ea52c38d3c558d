"""What the adapters make of the robot, in one run: `python benchmarks/adapters.py`.

  numpy     one robot as people write it for Gymnasium: C MuJoCo and NumPy (`one_robot.py`)
  gym       `JetBotGymEnv`: C MuJoCo and the task's own code
  vector    `JetBotVectorEnv`, the batch in MJX
  vecenv    `JetBotVecEnv`, the same for Stable-Baselines3
  sb3       Stable-Baselines3's PPO with the tutorial's hyperparameters, on numpy
  sb3-gym   the same on gym
  sb3-vec   the same on vecenv: as many steps between two updates, of all robots together

All rates are environment steps per second, from Python, resets included; the first four are under
random actions. All take turns. PyTorch has one thread, which is the fastest for such networks.
"""

import argparse
import importlib
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from compare import TABLE_HEAD, in_turns, missing, table_row
from contenders import Contender, Sb3, as_gymnasium
from measurements import Sizes
from one_robot import OneRobot
from results import check_output, conditions, counts, default_output, write
from timing import REPEAT_SECONDS, WARM_UP_CALLS, Row, make_row

from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError

_CONFIG = Path(__file__).resolve().parents[1] / "configs" / "jetbot.yaml"
_ACTIONS = 1024


class Stepped:
    """An environment under random actions, one call at a time."""

    def __init__(self, rate: str, env: Any, config: Config) -> None:
        """Takes it through some seconds of driving.

        Args:
          rate: what the row is called.
          env: a `gymnasium.Env`, `VectorEnv` or `VecEnv`.
          config: robot, task and physics.
        """
        self.rate, self.num_envs = rate, getattr(env, "num_envs", 1)
        self._env, self._n_substeps = env, config.physics.n_substeps
        self._resets = not hasattr(env, "num_envs")
        shape = (_ACTIONS, 2) if self._resets else (_ACTIONS, self.num_envs, 2)
        self._actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)
        env.reset()
        seconds = math.inf
        for _ in range(WARM_UP_CALLS):
            seconds = self._clocked(64) / 64
        self._calls = max(64, math.ceil(REPEAT_SECONDS / seconds))

    def repeat(self) -> float:
        """Environment steps per second over one repeat."""
        return self.num_envs * self._calls / self._clocked(self._calls)

    def row(self, repeats: list[float]) -> Row:
        """What was measured."""
        return make_row(self.rate, self._n_substeps, self.num_envs, 0.0, repeats, self._calls)

    def _clocked(self, calls: int) -> float:
        begun = time.perf_counter()
        for index in range(calls):
            result = self._env.step(self._actions[index % _ACTIONS])
            if self._resets and (result[2] or result[3]):
                self._env.reset()
        return time.perf_counter() - begun


def prepare(config: Config, num_envs: Sequence[int]) -> list[Contender]:
    """Builds all that takes turns.

    Args:
      config: robot, task and physics.
      num_envs: sizes of the batches; PPO takes the last.

    Returns:
      The contenders.
    """
    adapters = importlib.import_module("jetbot_mjx.adapters")
    sb3 = importlib.import_module("jetbot_mjx.adapters.stable_baselines3")
    makers: dict[str, Callable[..., Any]] = {
        "vector": adapters.JetBotVectorEnv,
        "vecenv": sb3.JetBotVecEnv,
    }
    contenders: list[Contender] = [
        Stepped("numpy", as_gymnasium(OneRobot(config)), config),
        Stepped("gym", adapters.JetBotGymEnv(config=config), config),
    ]
    for rate, make in makers.items():
        contenders += [Stepped(rate, make(count, config=config), config) for count in num_envs]
    vec_env = sb3.JetBotVecEnv(num_envs[-1], config=config)
    return [
        *contenders,
        Sb3(config),
        Sb3(config, adapters.JetBotGymEnv(config=config), rate="sb3-gym"),
        Sb3(config, vec_env, rate="sb3-vec"),
    ]


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=_CONFIG, help="default: configs/jetbot.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--num-envs", type=counts, default=(16, 64), metavar="N,N,...")
    parser.add_argument("--repeats", type=cli.positive_int, default=5, help="rounds (default: 5)")
    parser.add_argument("--output", type=Path, help="default: results/adapters-<device>.json")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, measures, prints the table and writes the JSON file.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      The exit code.

    Raises:
      UserError: a package is missing, or the file cannot be written.
    """
    options = _parser().parse_args(arguments)
    if line := missing("sb3"):
        raise UserError(line)
    config = load_config(options.config, options.overrides)
    output = options.output or default_output("adapters-")
    check_output(output)
    measured = conditions(config, Sizes(repeats=options.repeats))
    print(
        f"{options.config.name} on {jax.device_count()} x {measured['device']} and"
        f" {measured['cpu_cores']} CPU cores, median of {options.repeats}\n{TABLE_HEAD}",
        flush=True,
    )
    results = in_turns(prepare(config, options.num_envs), options.repeats)
    for row, busy in results:
        print(table_row(row, busy))
    write(
        output,
        {**measured, "adapters": [{**row._asdict(), "busy_cores": busy} for row, busy in results]},
    )
    print(f"results: {output}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
