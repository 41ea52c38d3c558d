"""What drawing a robot for every episode costs: `python benchmarks/randomization_cost.py`.

The environment alone (`env`) and the whole training (`training`) under one configuration, with
its `randomization` and without, in turn, so that what else the machine does meets both. The cost
of a round is the rate without over the rate with it, less one; told is the median over rounds.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from measurements import Sizes, prepare_env, training_config
from results import check_output, conditions, default_output, write

from jetbot_mjx import cli
from jetbot_mjx.config import Config, RandomizationConfig, load_config
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.training.ppo_trainer import CompiledTrainer

_CONFIG = Path(__file__).resolve().parents[1] / "configs" / "real_jetbot.yaml"
WAYS = ("off", "on")

Rates = dict[str, list[float]]
"""Environment steps per second of each round, by way."""


def _without(config: Config) -> Config:
    return config.model_copy(update={"randomization": RandomizationConfig()})


def measure_env(config: Config, num_envs: int, sizes: Sizes) -> Rates:
    """Times the environment as trainers see it.

    Args:
      config: with ranges to draw from.
      num_envs: how many.
      sizes: rounds, and steps of a call.

    Returns:
      The rates.
    """
    pair = [prepare_env(one, num_envs, sizes) for one in (_without(config), config)]
    return _in_turns([one.repeat for one in pair], sizes.repeats)


def measure_training(config: Config, num_envs: int, sizes: Sizes) -> Rates:
    """Times training steps, updates included.

    Args:
      config: with ranges to draw from.
      num_envs: how many.
      sizes: rounds, and training steps of each.

    Returns:
      The rates.
    """
    config = training_config(config, num_envs, sizes, trainer="resumable")
    pair = [_Training(one, sizes.training_steps) for one in (_without(config), config)]
    return _in_turns([one.repeat for one in pair], sizes.repeats)


class _Training:
    """A compiled training that goes on at every call."""

    def __init__(self, config: Config, steps: int) -> None:
        program = CompiledTrainer.from_config(config, make_env(config))
        self._advance = program.compile()
        self._state = program.init()
        self._steps, self._size = steps, config.ppo.steps_per_training_step
        self._clocked(1)

    def repeat(self) -> float:
        return self._size * self._steps / self._clocked(self._steps)

    def _clocked(self, steps: int) -> float:
        begun = time.perf_counter()
        self._state, _ = jax.block_until_ready(self._advance(self._state, steps, False))
        return time.perf_counter() - begun


def _in_turns(repeats: Sequence[Callable[[], float]], rounds: int) -> Rates:
    found: Rates = {way: [] for way in WAYS}
    for _ in range(rounds):
        for way, repeat in zip(WAYS, repeats, strict=True):
            found[way].append(repeat())
    return found


def cost(rates: Mapping[str, Sequence[float]]) -> float:
    """By how much more time a step takes: median over the rounds.

    Args:
      rates: of both ways.

    Returns:
      A fraction of the time without.
    """
    pairs = zip(rates["off"], rates["on"], strict=True)
    return statistics.median(off / on for off, on in pairs) - 1.0


def _line(name: str, rates: Rates) -> str:
    costs = [off / on - 1.0 for off, on in zip(rates["off"], rates["on"], strict=True)]
    medians = {way: statistics.median(values) for way, values in rates.items()}
    return (
        f"{name:8}  {medians['off']:>12,.0f}  {medians['on']:>12,.0f}  {cost(rates):>7.1%}"
        f"  {min(costs):.1%} .. {max(costs):.1%}"
    )


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, default=_CONFIG)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--num-envs", type=cli.positive_int, help="default: the configuration's")
    parser.add_argument("--repeats", type=cli.positive_int, default=9, help="rounds (default: 9)")
    parser.add_argument("--unroll", type=cli.positive_int, default=64)
    parser.add_argument("--training-steps", type=cli.positive_int, default=4)
    parser.add_argument("--most", type=cli.fraction, default=0.15, help="default: 0.15")
    parser.add_argument("--output", type=Path, help="JSON file")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, measures and prints.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 1 where training costs more than `--most`.
    """
    options = _parser().parse_args(arguments)
    config = load_config(options.config, options.overrides)
    if not config.randomization.drawn:
        raise UserError(f"--config {options.config}: its randomization draws nothing")
    cli.require_device()
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
