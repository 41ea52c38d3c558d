"""Measure steps per second: `python benchmarks/steps_per_second.py --num-envs 256,1024`.

Six rates for each number of environments, each of a program of its own:
  physics   `Physics.step` alone, under random actions
  switched  `physics` under commands of ±1 that each robot holds for 1 to 24 steps
  env       the training environment: observation, reward, episode statistics, resets to new goals
  rollout   `env` under the exploring policy, with the transitions that PPO stores
  training  PPO by the trainer of `jetbot-mjx train`: rollouts and updates
  brax      PPO by Brax's own `ppo.train` with the same hyperparameters
benchmarks/README.md explains how each is measured and how to read the table.
"""

import argparse
import itertools
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import CONFIGS
from benchmarks.harness.formatting import format_spread
from benchmarks.harness.measurements import MEASUREMENTS, Sizes, training_config
from benchmarks.harness.results import check_output, conditions, counts, default_output, write
from benchmarks.harness.timing import Row
from benchmarks.reliability.regressions import MOST_SLOWDOWN, Change, changes, read_baseline
from benchmarks.throughput.rate_plots import draw
from jetbot_mjx import cli, startup
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import collect


def run(
    config: Config,
    num_envs: Sequence[int],
    sizes: Sizes,
    *,
    rates: Sequence[str] = tuple(MEASUREMENTS),
    report: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Measure every rate at every number of environments.

    Args:
      config: The robot, task, physics and networks; its number of environments is not used.
      num_envs: The numbers of environments.
      sizes: How much is measured.
      rates: The names of the rates in `MEASUREMENTS`.
      report: A callback that receives each row as soon as it is measured.

    Returns:
      The rows.

    Raises:
      UserError: The environments cannot be divided among minibatches or devices, or states are
        not finite.
    """
    rows = []
    for count in num_envs:
        for rate in rates:
            rows.append(MEASUREMENTS[rate](config, count, sizes))
            report(rows[-1])
    return rows


_TABLE_HEAD = (
    f"| {'rate':8} | {'num_envs':>8} | {'env_steps_per_second':>20} |"
    f" {'physics_steps_per_second':>24} | {'µs/step':>9} | {'compile':>8} | {'min .. max':>18} |\n"
    f"|:{'-' * 8}-|-{'-' * 8}:|-{'-' * 20}:|-{'-' * 24}:|-{'-' * 9}:|-{'-' * 8}:|-{'-' * 18}:|"
)


def _table_row(row: Row) -> str:
    spread = format_spread(row.env_steps_per_second, row.repeats)
    return (
        f"| {row.rate:8} | {row.num_envs:8,} | {row.env_steps_per_second:20,.0f} |"
        f" {row.physics_steps_per_second:24,.0f} | {row.microseconds_per_step:9,.1f} |"
        f" {row.compile_seconds:6.1f} s | {spread:>18} |"
    )


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--config",
        type=Path,
        default=CONFIGS / "jetbot.yaml",
        help="default: configs/jetbot.yaml",
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override one setting; may be given again",
    )
    parser.add_argument(
        "--num-envs", type=counts, metavar="N,N,...", help="default: the config's ppo.num_envs"
    )
    for name, default in Sizes()._asdict().items():
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            type=cli.positive_int,
            default=default,
            metavar="N",
            help=f"{_SIZES_HELP[name]} (default: {default})",
        )
    parser.add_argument(
        "--skip",
        action="append",
        default=[],
        choices=list(MEASUREMENTS),
        help="a rate that is not measured; may be given again",
    )
    parser.add_argument("--output", type=Path, help="default: benchmarks/results/<device>.json")
    parser.add_argument(
        "--compare",
        type=Path,
        metavar="OLD.json",
        help=f"an earlier file; exit code 1 if a rate is more than {MOST_SLOWDOWN:.0%}% slower",
    )
    return parser


_SIZES_HELP = {
    "repeats": "number of timings of each rate",
    "unroll": "environment steps in one compiled call; `rollout` rounds up to whole unrolls",
    "training_steps": "training steps in one timing of `training` and `brax`",
}


def _change_line(change: Change) -> str:
    return (
        f"{change.rate:8} at {change.num_envs:8,}: {change.before:13,.0f} ->"
        f" {change.after:13,.0f} steps/s, {change.relative:+.1%}"
        + (", SLOWER" if change.is_slower else "")
    )


def _read_earlier(
    path: Path | None, measured: Mapping[str, Any], asked: Iterable[tuple[str, int]]
) -> dict[tuple[str, int], float]:
    """Read the rates to compare with; none without a file.

    Args:
      path: The file given by `--compare`.
      measured: The conditions of this measurement.
      asked: The rates that will be measured, each with its number of environments.

    Raises:
      UserError: The file cannot be compared with, or has none of the rates.
    """
    if path is None:
        return {}
    baseline = read_baseline(path, measured)
    if not set(asked) & set(baseline):
        raise UserError(
            f"--compare {path} has none of these rates: it has"
            f" {', '.join(f'{rate} at {count}' for rate, count in baseline) or 'no rate at all'}"
        )
    return baseline


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the rates, print the table, and write the JSON file and the plot.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if a rate is slower than in the file given by `--compare`.

    Raises:
      UserError: As for `run`, or a file cannot be written or compared with.
    """
    # Check all arguments before minutes of measuring.
    options = _parser().parse_args(arguments)
    config = load_config(options.config, options.overrides)
    startup.divide_cpu(config.cpu_devices)
    sizes = Sizes(options.repeats, options.unroll, options.training_steps)
    num_envs = options.num_envs or [config.ppo.num_envs]
    rates = [rate for rate in MEASUREMENTS if rate not in options.skip]
    if not rates:
        raise UserError("--skip leaves nothing to measure: skip fewer rates")
    if "training" in rates:
        for count in num_envs:
            training_config(config, count, sizes, config.trainer)
    output = options.output or default_output()
    check_output(output)
    measured = conditions(config, sizes)
    baseline = _read_earlier(options.compare, measured, itertools.product(rates, num_envs))
    # Measure; the file is written after every row, so that an interrupted sweep keeps its rows.
    rows: list[Row] = []

    def report(row: Row) -> None:
        rows.append(row)
        print(_table_row(row), flush=True)
        rates = [row._asdict() for row in rows]
        write(output, {**measured, "fallbacks": fallbacks, "results": rates})

    print(
        f"{options.config.name} on {jax.device_count()} x {measured['device']}, median of"
        f" {sizes.repeats} repeats\n{_TABLE_HEAD}",
        flush=True,
    )
    with collect() as fallbacks:
        run(config, num_envs, sizes, rates=rates, report=report)
    for fallback in fallbacks:
        print(f"slow: {fallback}")
    for row in rows:
        if row.nonfinite_envs:
            print(f"{row.rate} at {row.num_envs}: {row.nonfinite_envs} non-finite states")
    # Draw the plot and compare with the earlier file.
    plot = draw(output, {**measured, "results": [row._asdict() for row in rows]})
    print(f"results: {output}, {plot.name}")
    found = changes(rows, baseline)
    for change in found:
        print(_change_line(change))
    return 1 if any(change.is_slower for change in found) else 0


if __name__ == "__main__":
    cli.run_command(main)
