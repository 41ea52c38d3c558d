"""Compare with other simulators and trainers: `python benchmarks/throughput/compare.py`.

  physics     this project's `Physics.step` under random actions
  mujoco      C MuJoCo's threaded `mujoco.rollout` with the same model, sub-steps and actions
  warp        MJX-Warp with the same model, on an NVIDIA GPU
  env         this project's training environment under random actions
  playground  MuJoCo Playground's CartpoleBalance, a smaller model, with its training wrappers
  training    this project's PPO, rollouts and updates
  brax        Brax's own `ppo.train` with the same hyperparameters
  sb3         Stable-Baselines3's PPO with the tutorial's hyperparameters, one robot in C MuJoCo

All rates are environment steps per second. The first three are timed in turn in every round, so
that other load on the machine affects all of them alike. A benchmark whose package is not
installed is skipped, with one line that says so.
"""

import argparse
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from benchmarks.harness.formatting import format_spread
from benchmarks.harness.measurements import (
    MEASUREMENTS,
    Sizes,
    prepare_env,
    prepare_physics,
    training_config,
)
from benchmarks.harness.results import check_output, conditions, counts, default_output, write
from benchmarks.harness.timing import Row, available_cores
from benchmarks.throughput.baselines import (
    Benchmark,
    MujocoRollout,
    Sb3,
    prepare_playground,
    prepare_warp,
)
from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError

_OTHERS = ("mujoco", "warp")
"""Other simulators of the same robot."""
BENCHMARKS = ("physics", *_OTHERS, "env", "playground", "training", "brax", "sb3")
_NEEDS = {
    "playground": (
        ("mujoco_playground", "lxml"),
        # Its own requirements would install a MuJoCo release other than MJX's.
        "pip install --no-deps playground lxml",
    ),
    "sb3": (
        ("torch", "stable_baselines3", "gymnasium"),
        "pip install -c constraints.txt '.[sb3]', best after torch's build for CPUs",
    ),
    "warp": (("warp",), "pip install 'mujoco-mjx[warp]'"),
}
_BATCHES = {"cpu": (64, 128, 256, 512), "gpu": (4_096, 65_536)}
_ROLLOUT_BATCHES = (16, 64, 256)
"""Robots for each core."""


Result = tuple[Row, list[float]]
"""A row, and the busy cores of each repeat: processor time over wall time."""


def run(
    config: Config,
    num_envs: Sequence[int],
    sizes: Sizes,
    *,
    names: Sequence[str],
    report: Callable[[Sequence[Result]], None],
) -> None:
    """Measure the named benchmarks.

    Args:
      config: The robot, task, physics and hyperparameters.
      num_envs: The numbers of environments for physics; `env` and `playground` use the best.
      sizes: How much is measured.
      names: Names from `BENCHMARKS` whose packages are installed.
      report: A callback that receives results as soon as they are measured.

    Raises:
      UserError: States are not finite, or the environments cannot be divided among minibatches
        or devices.
    """
    # The simulators of the same robot are timed in turn.
    turns: list[Benchmark] = []
    if "physics" in names:
        turns += [prepare_physics(config, count, sizes) for count in num_envs]
    if "mujoco" in names:
        batches = [count * available_cores() for count in _ROLLOUT_BATCHES]
        turns += [MujocoRollout(config, count, sizes) for count in batches]
    if "warp" in names:
        turns += [prepare_warp(config, count, sizes) for count in num_envs]
    measured = in_turns(turns, sizes.repeats)
    report(measured)
    # All others are timed one after the other.
    best = _best([row for row, _ in measured])
    count = best["physics"].num_envs if "physics" in best else num_envs[0]
    prepare: Mapping[str, Callable[[], Benchmark]] = {
        "env": lambda: prepare_env(config, count, sizes),
        "playground": lambda: prepare_playground(count, sizes),
        "sb3": lambda: Sb3(config),
    }
    for name in names:
        if name in prepare:
            report(in_turns([prepare[name]()], sizes.repeats))
        elif name not in ("physics", *_OTHERS):
            # The rates of a trainer come from its own reports.
            wall, cpu = time.perf_counter(), time.process_time()
            row = MEASUREMENTS[name](config, config.ppo.num_envs, sizes)
            report([(row, [(time.process_time() - cpu) / (time.perf_counter() - wall)])])


def ratios(results: Sequence[Result], other: str, *, per_core: bool = False) -> list[float]:
    """Return the ratios of `physics` to another, each at its best number of environments.

    Args:
      results: The measured results.
      other: `mujoco` or `warp`.
      per_core: Whether to compare steps per second of processor time instead of wall time.

    Returns:
      The ratio of each round; an empty list if one of them was not measured.
    """
    best = _best([row for row, _ in results])
    if not {"physics", other} <= set(best):
        return []
    ours, theirs = (
        [rate / (busy if per_core else 1.0) for rate, busy in zip(row.repeats, cores, strict=True)]
        for name in ("physics", other)
        for row, cores in results
        if row is best[name]
    )
    return [one / another for one, another in zip(ours, theirs, strict=True)]


def _best(rows: Sequence[Row]) -> dict[str, Row]:
    return {row.rate: row for row in sorted(rows, key=lambda row: row.env_steps_per_second)}


def in_turns(benchmarks: Sequence[Benchmark], rounds: int) -> list[Result]:
    """Time each benchmark once in every round, and return their rows and busy cores."""
    rates: list[list[float]] = [[] for _ in benchmarks]
    cores: list[list[float]] = [[] for _ in benchmarks]
    for _ in range(rounds):
        for index, benchmark in enumerate(benchmarks):
            wall, cpu = time.perf_counter(), time.process_time()
            rates[index].append(benchmark.repeat())
            used = time.process_time() - cpu
            cores[index].append(used / (time.perf_counter() - wall))
    return [
        (benchmark.row(one), used)
        for benchmark, one, used in zip(benchmarks, rates, cores, strict=True)
    ]


def missing(name: str) -> str | None:
    """Return in one line why a benchmark is skipped; None: nothing is missing."""
    if name == "warp" and jax.default_backend() != "gpu":
        return "warp skipped: MJX-Warp needs an NVIDIA GPU"
    packages, remedy = _NEEDS.get(name, ((), ""))
    absent = [package for package in packages if importlib.util.find_spec(package) is None]
    return f"{name} skipped, {', '.join(absent)} not installed: {remedy}" if absent else None


TABLE_HEAD = (
    f"| {'':10} | {'num_envs':>8} | {'env_steps_per_second':>20} | {'compile':>8} |"
    f" {'busy cores':>10} | {'min .. max':>18} |\n"
    f"|:{'-' * 10}-|-{'-' * 8}:|-{'-' * 20}:|-{'-' * 8}:|-{'-' * 10}:|-{'-' * 18}:|"
)


def table_row(row: Row, busy: Sequence[float]) -> str:
    """Return one row of the printed table."""
    spread = format_spread(row.env_steps_per_second, row.repeats)
    return (
        f"| {row.rate:10} | {row.num_envs:8,} | {row.env_steps_per_second:20,.0f} |"
        f" {row.compile_seconds:6.1f} s | {statistics.median(busy):10.2f} | {spread:>18} |"
    )


def _as_json(results: Sequence[Result]) -> dict[str, Any]:
    return {
        "comparison": [{**row._asdict(), "busy_cores": busy} for row, busy in results],
        **{
            f"physics_over_{other}{'_per_core' if per_core else ''}": ratios(
                results, other, per_core=per_core
            )
            for other, per_core in _compared()
        },
    }


def _compared() -> list[tuple[str, bool]]:
    """Return pairs of another simulator and whether it is compared by processor time.

    On a GPU processor time is not compared, because physics uses almost none.
    """
    on_cpu = jax.default_backend() == "cpu"
    return [("mujoco", False), *([("mujoco", True)] if on_cpu else []), ("warp", False)]


def ratio_lines(results: Sequence[Result]) -> list[str]:
    """Return the printed ratios of `physics` to the other simulators that were measured."""
    lines = []
    for other, per_core in _compared():
        if found := ratios(results, other, per_core=per_core):
            unit = "second of processor time" if per_core else "second"
            lines.append(
                f"physics over {other}, steps per {unit}: {statistics.median(found):.2f}"
                f" ({min(found):.2f} .. {max(found):.2f} over {len(found)} rounds)"
            )
    return lines


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--config", type=Path, default=CONFIGS / "jetbot.yaml", help="default: configs/jetbot.yaml"
    )
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--num-envs",
        type=counts,
        metavar="N,N,...",
        help="numbers of environments for physics (default: 64,128,256,512, on a GPU 4096,65536)",
    )
    parser.add_argument("--repeats", type=cli.positive_int, default=5, help="rounds (default: 5)")
    parser.add_argument("--training-steps", type=cli.positive_int, default=4, help="default: 4")
    parser.add_argument("--skip", action="append", default=[], choices=BENCHMARKS)
    parser.add_argument("--output", type=Path, help="default: results/compare-<device>.json")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table and the ratios, and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.

    Raises:
      UserError: As for `run`, or the file cannot be written.
    """
    # Check all arguments before minutes of measuring.
    options = _parser().parse_args(arguments)
    config = load_config(options.config, options.overrides)
    sizes = Sizes(repeats=options.repeats, training_steps=options.training_steps)
    lines = {name: missing(name) for name in BENCHMARKS if name not in options.skip}
    names = [name for name, line in lines.items() if line is None]
    if not names:
        raise UserError("--skip leaves nothing to compare: skip fewer")
    for name, trainer in {"training": "resumable", "brax": "brax"}.items():
        if name in names:
            training_config(config, config.ppo.num_envs, sizes, trainer)
    output = options.output or default_output("compare-")
    check_output(output)
    measured = conditions(config, sizes)
    # Measure; results are printed and written as soon as they are measured.
    for line in filter(None, lines.values()):
        print(line)
    print(
        f"{options.config.name} on {jax.device_count()} x {measured['device']} and"
        f" {measured['cpu_cores']} CPU cores, median of {sizes.repeats}\n{TABLE_HEAD}",
        flush=True,
    )
    platform = "cpu" if jax.default_backend() == "cpu" else "gpu"
    found: list[Result] = []

    def report(more: Sequence[Result]) -> None:
        found.extend(more)
        for row, busy in more:
            print(table_row(row, busy), flush=True)
        write(output, {**measured, **_as_json(found)})

    run(
        config,
        options.num_envs or _BATCHES[platform],
        sizes,
        names=names,
        report=report,
    )
    for line in ratio_lines(found):
        print(line)
    print(f"results: {output}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
