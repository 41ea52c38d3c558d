"""Measure the Gymnasium and Stable-Baselines3 adapters: `python benchmarks/throughput/adapters.py`.

  numpy     one robot in C MuJoCo and NumPy, without this package (`one_robot.py`)
  gym       `JetBotGymEnv`: one robot in C MuJoCo with the task's own code
  vector    `JetBotVectorEnv`: a batch of robots in MJX
  vecenv    `JetBotVecEnv`: the same batch for Stable-Baselines3
  sb3       Stable-Baselines3's PPO with the tutorial's hyperparameters, on `numpy`
  sb3-gym   the same PPO on `gym`
  sb3-vec   the same PPO on `vecenv`, with equally many steps of all robots between two updates

All rates are environment steps per second as called from Python, including resets; the first four
use random actions. All are timed in turn. PyTorch uses one thread, the fastest for such networks.
"""

import argparse
import importlib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from benchmarks.harness.measurements import Sizes
from benchmarks.harness.results import check_output, conditions, counts, default_output, write
from benchmarks.harness.timing import Row, make_row, warm_up
from benchmarks.throughput.baselines import Benchmark, Sb3, as_gymnasium
from benchmarks.throughput.compare import TABLE_HEAD, in_turns, missing, table_row
from benchmarks.throughput.one_robot import OneRobot
from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError

_ACTIONS = 1024
_LEAST_CALLS = 64


class SteppedEnv:
    """An environment that is stepped from Python under random actions."""

    def __init__(self, rate: str, env: Any, config: Config) -> None:
        """Draw the actions and warm up.

        Args:
          rate: The name of the row.
          env: A `gymnasium.Env`, `VectorEnv` or `VecEnv`.
          config: The robot, task and physics.
        """
        self.rate, self.num_envs = rate, getattr(env, "num_envs", 1)
        self._env, self._n_substeps = env, config.physics.n_substeps
        self._is_single = not hasattr(env, "num_envs")  # batches reset themselves
        shape = (_ACTIONS, 2) if self._is_single else (_ACTIONS, self.num_envs, 2)
        self._actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)
        env.reset()
        self._calls = warm_up(self._time_calls, at_least=_LEAST_CALLS)

    def repeat(self) -> float:
        """Return the environment steps per second of one repeat."""
        return self.num_envs * self._calls / self._time_calls(self._calls)

    def row(self, repeats: list[float]) -> Row:
        """Return the measured row."""
        return make_row(self.rate, self._n_substeps, self.num_envs, 0.0, repeats, self._calls)

    def _time_calls(self, calls: int) -> float:
        start = time.perf_counter()
        for index in range(calls):
            result = self._env.step(self._actions[index % _ACTIONS])
            if self._is_single and (result[2] or result[3]):
                self._env.reset()
        return time.perf_counter() - start


def prepare(config: Config, num_envs: Sequence[int]) -> list[Benchmark]:
    """Build all benchmarks.

    Args:
      config: The robot, task and physics.
      num_envs: The sizes of the batches; PPO uses the last one.
    """
    adapters = importlib.import_module("jetbot_mjx.adapters")
    sb3 = importlib.import_module("jetbot_mjx.adapters.stable_baselines3")
    makers: dict[str, Callable[..., Any]] = {
        "vector": adapters.JetBotVectorEnv,
        "vecenv": sb3.JetBotVecEnv,
    }
    benchmarks: list[Benchmark] = [
        SteppedEnv("numpy", as_gymnasium(OneRobot(config)), config),
        SteppedEnv("gym", adapters.JetBotGymEnv(config=config), config),
    ]
    for rate, make in makers.items():
        benchmarks += [SteppedEnv(rate, make(count, config=config), config) for count in num_envs]
    vec_env = sb3.JetBotVecEnv(num_envs[-1], config=config)
    return [
        *benchmarks,
        Sb3(config),
        Sb3(config, adapters.JetBotGymEnv(config=config), rate="sb3-gym"),
        Sb3(config, vec_env, rate="sb3-vec"),
    ]


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--config", type=Path, default=CONFIGS / "jetbot.yaml", help="default: configs/jetbot.yaml"
    )
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--num-envs", type=counts, default=(16, 64), metavar="N,N,...")
    parser.add_argument("--repeats", type=cli.positive_int, default=5, help="rounds (default: 5)")
    parser.add_argument("--output", type=Path, help="default: results/adapters-<device>.json")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.

    Raises:
      UserError: A package is missing, or the file cannot be written.
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
