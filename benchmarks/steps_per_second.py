"""Measures how fast robots step: `python benchmarks/steps_per_second.py --num-envs 256,1024`.

Six rates, each of a program of its own, for each number of environments:
  physics   `JetBotEnv.step_physics` alone, under random actions
  switched  the same under commands of ±1 that each robot holds for 1 to 24 steps
  env       the whole training environment: observation, reward, books, resets to new goals
  rollout   the same under the exploring policy, with the transitions that PPO stores
  training  PPO by the trainer of `python -m jetbot_mjx.train`: rollouts and updates
  stock     the same hyperparameters by Brax's own `ppo.train`, for comparison
README.md beside this file says how each is measured and how to read the table.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
from measurements import MEASUREMENTS, Sizes, training_config
from rate_plots import draw
from regressions import MOST_SLOWDOWN, Change, changes, read_baseline
from results import check_output, conditions, counts, default_output, write
from timing import Row

from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError

_CONFIG = Path(__file__).resolve().parents[1] / "configs" / "jetbot.yaml"


def run(
    config: Config,
    num_envs: Sequence[int],
    sizes: Sizes,
    *,
    rates: Sequence[str] = tuple(MEASUREMENTS),
    report: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Measures.

    Args:
      config: robot, task, physics and networks; its own number of environments is not used.
      num_envs: numbers of environments.
      sizes: how much is measured.
      rates: which, by their names in `MEASUREMENTS`.
      report: called with every row as soon as it is there.

    Returns:
      The rows.

    Raises:
      UserError: the environments cannot be dealt out, or worlds blew up.
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
    low, high = (end / row.env_steps_per_second - 1 for end in (min(row.repeats), max(row.repeats)))
    spread = f"{low:+.1%} .. {high:+.1%}"
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
        default=_CONFIG,
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
        help="leave one rate out; may be given again",
    )
    parser.add_argument("--output", type=Path, help="default: benchmarks/results/<device>.json")
    parser.add_argument(
        "--compare",
        type=Path,
        metavar="OLD.json",
        help=f"an earlier file; exit code 1 where a rate is {MOST_SLOWDOWN:.0%}% slower than there",
    )
    return parser


_SIZES_HELP = {
    "repeats": "timings of each rate",
    "unroll": "environment steps in one compiled call, rounded up to whole unrolls in rollout",
    "training_steps": "training steps in one timing of training and of stock",
}


def _change_line(change: Change) -> str:
    return (
        f"{change.rate:8} at {change.num_envs:8,}: {change.before:13,.0f} ->"
        f" {change.after:13,.0f} steps/s, {change.relative:+.1%}"
        + (", SLOWER" if change.is_slower else "")
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, measures, prints the table and writes the JSON file.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 1 where a rate is slower than in the file that it is compared with.

    Raises:
      UserError: as for `run`, or a file cannot be written or compared with.
    """
    options = _parser().parse_args(arguments)
    config = load_config(options.config, options.overrides)
    sizes = Sizes(options.repeats, options.unroll, options.training_steps)
    num_envs = options.num_envs or [config.ppo.num_envs]
    rates = [rate for rate in MEASUREMENTS if rate not in options.skip]
    if not rates:
        raise UserError("--skip leaves nothing to measure: leave out fewer rates")
    if "training" in rates:
        # Said before minutes of measuring, not after them.
        for count in num_envs:
            training_config(config, count, sizes, config.trainer)
    output = options.output or default_output()
    check_output(output)
    measured = conditions(config, sizes)
    baseline = read_baseline(options.compare, measured) if options.compare else {}
    if options.compare and not {(rate, count) for rate in rates for count in num_envs} & set(
        baseline
    ):
        raise UserError(
            f"--compare {options.compare} has none of these rates: it has"
            f" {', '.join(f'{rate} at {count}' for rate, count in baseline) or 'no rate at all'}"
        )
    rows: list[Row] = []

    def report(row: Row) -> None:
        rows.append(row)
        print(_table_row(row), flush=True)
        # After every row, so that a sweep that runs out of memory keeps what it had.
        write(output, {**measured, "results": [row._asdict() for row in rows]})

    print(
        f"{options.config.name} on {jax.device_count()} x {measured['device']}, median of"
        f" {sizes.repeats} repeats\n{_TABLE_HEAD}",
        flush=True,
    )
    run(config, num_envs, sizes, rates=rates, report=report)
    for row in rows:
        if row.nonfinite_envs:
            print(f"{row.rate} at {row.num_envs}: {row.nonfinite_envs} worlds blew up")
    picture = draw(output, {**measured, "results": [row._asdict() for row in rows]})
    print(f"results: {output}, {picture.name}")
    found = changes(rows, baseline)
    for change in found:
        print(_change_line(change))
    return 1 if any(change.is_slower for change in found) else 0


if __name__ == "__main__":
    cli.run_command(main)
