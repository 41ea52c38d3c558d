"""Measure the cost of domain randomization: `python benchmarks/throughput/randomization_cost.py`.

Times the environment alone (`env`) and the whole training (`training`) in turn with and without
the configuration's `randomization`, so that other load on the machine affects both alike. The cost
of a round is the rate without randomization divided by the rate with it, minus 1; the printed
cost is the median over the rounds.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from benchmarks.harness.measurements import Sizes, prepare_env, training_config
from benchmarks.harness.results import check_output, conditions, default_output, write
from jetbot_mjx import cli
from jetbot_mjx.config import Config, RandomizationConfig, load_config
from jetbot_mjx.devices import require_device
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup
from jetbot_mjx.training.ppo_trainer import CompiledTrainer

SETTINGS = ("off", "on")

Rates = dict[str, list[float]]
"""Environment steps per second of each round, by setting of randomization."""


def _without(config: Config) -> Config:
    return config.model_copy(update={"randomization": RandomizationConfig()})


def measure_env(config: Config, num_envs: int, sizes: Sizes) -> Rates:
    """Time the environment with the training wrappers, without and with randomization.

    Args:
      config: A configuration with randomization.
      num_envs: The number of environments.
      sizes: The number of rounds, and of environment steps in a call.

    Returns:
      The rates.
    """
    pair = [prepare_env(one, num_envs, sizes) for one in (_without(config), config)]
    return _in_turns([one.repeat for one in pair], sizes.repeats)


def measure_training(config: Config, num_envs: int, sizes: Sizes) -> Rates:
    """Time training steps, including the updates, without and with randomization.

    Args:
      config: A configuration with randomization.
      num_envs: The number of environments.
      sizes: The number of rounds, and of training steps in each.

    Returns:
      The rates.
    """
    config = training_config(config, num_envs, sizes, trainer="resumable")
    pair = [_Training(one, sizes.training_steps) for one in (_without(config), config)]
    return _in_turns([one.repeat for one in pair], sizes.repeats)


class _Training:
    """A compiled training that continues with every call of `repeat`."""

    def __init__(self, config: Config, steps: int) -> None:
        program = CompiledTrainer.from_setup(Setup(config))
        self._advance = program.compile()
        self._state = program.init()
        self._steps, self._size = steps, config.ppo.steps_per_training_step
        self._time_steps(1)  # warm-up

    def repeat(self) -> float:
        return self._size * self._steps / self._time_steps(self._steps)

    def _time_steps(self, steps: int) -> float:
        start = time.perf_counter()
        self._state, _ = jax.block_until_ready(self._advance(self._state, steps, False))
        return time.perf_counter() - start


def _in_turns(repeats: Sequence[Callable[[], float]], rounds: int) -> Rates:
    rates: Rates = {setting: [] for setting in SETTINGS}
    for _ in range(rounds):
        for setting, repeat in zip(SETTINGS, repeats, strict=True):
            rates[setting].append(repeat())
    return rates


def cost(rates: Mapping[str, Sequence[float]]) -> float:
    """Return the additional time of a step as a fraction of the time without randomization.

    Args:
      rates: The rates of both settings.

    Returns:
      The median over the rounds.
    """
    return statistics.median(_costs(rates))


def _costs(rates: Mapping[str, Sequence[float]]) -> list[float]:
    return [off / on - 1.0 for off, on in zip(rates["off"], rates["on"], strict=True)]


def _line(name: str, rates: Rates) -> str:
    costs = _costs(rates)
    medians = {setting: statistics.median(values) for setting, values in rates.items()}
    return (
        f"{name:8}  {medians['off']:>12,.0f}  {medians['on']:>12,.0f}  {cost(rates):>7.1%}"
        f"  {min(costs):.1%} .. {max(costs):.1%}"
    )


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, default=CONFIGS / "real_jetbot.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--num-envs", type=cli.positive_int, help="default: the config's ppo.num_envs"
    )
    parser.add_argument("--repeats", type=cli.positive_int, default=9, help="rounds (default: 9)")
    parser.add_argument("--unroll", type=cli.positive_int, default=64)
    parser.add_argument("--training-steps", type=cli.positive_int, default=4)
    parser.add_argument(
        "--most", type=cli.fraction, default=0.15, help="exit code 1 above (default: 0.15)"
    )
    parser.add_argument(
        "--output", type=Path, help="default: results/randomization-cost-<device>.json"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if training costs more than `--most`.
    """
    options = _parser().parse_args(arguments)
    config = load_config(options.config, options.overrides)
    if not config.randomization.drawn:
        raise UserError(f"--config {options.config}: its randomization draws nothing")
    require_device()
    output = options.output or default_output("randomization-cost-")
    check_output(output)
    sizes = Sizes(options.repeats, options.unroll, options.training_steps)
    num_envs = options.num_envs or config.ppo.num_envs
    print(
        f"env_steps_per_second of {num_envs:,} environments with {len(config.randomization.drawn)}"
        f" quantities drawn, {jax.devices()[0].device_kind}\n"
        f"{'':8}  {'off':>12}  {'on':>12}  {'cost':>7}  min .. max"
    )
    measured: dict[str, Any] = {}
    for name, measure in (("env", measure_env), ("training", measure_training)):
        measured[name] = measure(config, num_envs, sizes)
        print(_line(name, measured[name]), flush=True)
        costs = {each: cost(rates) for each, rates in measured.items()}
        about = {**conditions(config, sizes), "num_envs": num_envs}
        write(output, {**about, "rates": measured, "costs": costs})
    return 1 if cost(measured["training"]) > options.most else 0


if __name__ == "__main__":
    cli.run_command(main)
