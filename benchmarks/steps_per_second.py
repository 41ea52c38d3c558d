"""Measures how fast robots step: `python benchmarks/steps_per_second.py --num-envs 256,1024`.

Five rates, each of a program of its own, for each number of environments:
  physics   `JetBotEnv.step_physics` alone, under random actions
  env       the whole training environment: observation, reward, books, resets to new goals
  rollout   the same under the exploring policy, with the transitions that PPO stores
  training  PPO by the trainer of `python -m jetbot_mjx.train`: rollouts and updates
  stock     the same hyperparameters by Brax's own `ppo.train`, for comparison
README.md beside this file says how each is measured and how to read the table.
"""

import argparse
import datetime
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from measurements import (
    MEASUREMENTS,
    WARM_UP_CALLS,
    WARM_UP_INTERVALS,
    Row,
    Sizes,
    training_config,
)

from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.run_folder import versions, write_json

_FOLDER = Path(__file__).resolve().parent


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


def _conditions(config: Config, sizes: Sizes) -> dict[str, Any]:
    """What the rates hold for, as JSON."""
    device = jax.devices()[0]
    return {
        "device": device.device_kind,
        "platform": device.platform,
        "device_count": jax.device_count(),
        "cpu_cores": os.cpu_count(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "versions": versions(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "config": config.model_dump(mode="json"),
        "conditions": {
            **sizes._asdict(),
            "warm_up_calls": WARM_UP_CALLS,
            "warm_up_intervals": WARM_UP_INTERVALS,
            # Of the networks; null is the back end's own choice. Physics sets its own.
            "matmul_precision": jax.config.values["jax_default_matmul_precision"],
            # Where there is one, a compile time may be that of reading from it.
            "compilation_cache": jax.config.values["jax_compilation_cache_dir"] is not None,
        },
    }


def _default_output() -> Path:
    """`results/<device>.json` beside this file, with the number of devices if there are more."""
    name = re.sub(r"[^a-z0-9]+", "-", jax.devices()[0].device_kind.lower()).strip("-")
    count = jax.device_count()
    return _FOLDER / "results" / (f"{name}-x{count}.json" if count > 1 else f"{name}.json")


def _check_output(path: Path) -> None:
    """Finds out before minutes of measuring whether the file can be written."""
    if path.is_dir():
        raise UserError(f"--output {path} is a folder: name a file in it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--output {path} cannot be written: {error.strerror}") from None


def _write(path: Path, values: dict[str, Any]) -> None:
    try:
        write_json(path, values)
    except OSError as error:
        raise UserError(f"--output {path} cannot be written: {error.strerror}") from None


def _counts(text: str) -> list[int]:
    """An argument that counts several things, as in 256,1024."""
    return [cli.positive_int(part) for part in text.split(",")]


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--config",
        type=Path,
        default=_FOLDER.parent / "configs" / "jetbot.yaml",
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
        "--num-envs", type=_counts, metavar="N,N,...", help="default: the config's ppo.num_envs"
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
    return parser


_SIZES_HELP = {
    "repeats": "timings of each rate",
    "unroll": "environment steps in one compiled call, rounded up to whole unrolls in rollout",
    "training_steps": "training steps in one timing of training and of stock",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, measures, prints the table and writes the JSON file.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      The exit code.

    Raises:
      UserError: as for `run`, or the file cannot be written.
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
    output = options.output or _default_output()
    _check_output(output)
    conditions = _conditions(config, sizes)
    rows: list[Row] = []

    def report(row: Row) -> None:
        rows.append(row)
        print(_table_row(row), flush=True)
        # After every row, so that a sweep that runs out of memory keeps what it had.
        _write(output, {**conditions, "results": [row._asdict() for row in rows]})

    print(
        f"{options.config.name} on {jax.device_count()} x {conditions['device']}, median of"
        f" {sizes.repeats} repeats\n{_TABLE_HEAD}",
        flush=True,
    )
    run(config, num_envs, sizes, rates=rates, report=report)
    for row in rows:
        if row.nonfinite_worlds:
            print(f"{row.rate} at {row.num_envs}: {row.nonfinite_worlds} worlds blew up")
    print(f"results: {output}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
