"""Measure the time until a policy succeeds.

    python benchmarks/learning/time_to_success.py --config configs/jetbot.yaml --output FILE

For each seed a new process trains from a cold start (an empty compilation cache), and another
evaluates its best policy on the fixed goals of the report; `--warm` repeats both with the cache
that the first training filled. The times are those of whole processes, including imports and
compilation. `--set trainer=brax` measures Brax's own `ppo.train`.

For an environment of one's own, `--target-return X` waits for a mean return in place of a success
rate.
"""

import argparse
import json
import os
import platform
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.processes import run_module
from benchmarks.harness.timing import available_cores
from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import write_json


class Target(NamedTuple):
    """A `Target` is what the first evaluation that is as good has to reach."""

    metric: str
    """`success_rate` or `episode_return`, a field of the metrics of a policy."""
    value: float

    @property
    def name(self) -> str:
        """Return the metric in one word."""
        return "success" if self.metric == SUCCESS else "return"

    def is_reached(self, metrics: dict[str, Any], prefix: str = "") -> bool:
        """Return whether metrics are as good as the target."""
        return metrics[prefix + self.metric] >= self.value

    def format(self, value: float) -> str:
        """Return a value of the metric as text."""
        return f"{value:.2%}" if self.metric == SUCCESS else f"{value:,.1f}"


SUCCESS, RETURN = "success_rate", "episode_return"


def measure(
    config: Path, overrides: Sequence[str], seed: int, target: Target, cache: Path
) -> dict[str, Any]:
    """Train and evaluate one seed.

    Args:
      config: The YAML file.
      overrides: The settings, as for `--set`.
      seed: The seed of the run.
      target: The first evaluation that reaches it is recorded.
      cache: The folder of the compilation cache; an empty one makes a cold start.

    Returns:
      Times, metrics and the output of both processes, as JSON.

    Raises:
      UserError: One of the processes failed.
    """
    # Train and evaluate in processes of their own, and read what they wrote.
    start = "warm" if cache.is_dir() and any(cache.iterdir()) else "cold"
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)}
        settings = [argument for override in overrides for argument in ("--set", override)]
        arguments = ["--config", str(config), "--seed", str(seed), *settings]
        began = time.perf_counter()
        printed = run_module("train", [*arguments, "--run-dir", str(run_dir)], environment)
        seconds = time.perf_counter() - began
        printed += run_module("evaluate", [str(run_dir)], environment)
        report = json.loads(next(run_dir.glob("evaluations/*/report.json")).read_text())
        lines = (run_dir / "metrics.jsonl").read_text().splitlines()
        history = [json.loads(line) for line in lines]
        # Read from the run: JAX in this process would take the GPU's memory from the trainings.
        versions = json.loads((run_dir / "versions.json").read_text())
    if report["policy"][target.metric] is None:
        raise UserError(f"{config}: its environment tells no success: give --target-return")
    reached = [line for line in history if target.is_reached(line, "eval/")]
    first_step = re.search(r"first training step done ([\d.]+) s", printed)
    return {
        "seed": seed,
        "start": start,
        "first_step_seconds": float(first_step[1]) if first_step else None,
        "process_seconds": seconds,
        "compile_seconds": sum(line["time/compile_seconds"] for line in history),
        "target_reached_seconds": reached[0]["time/wall_seconds"] if reached else None,
        "target_reached_steps": reached[0]["env_steps"] if reached else None,
        "curve": [
            {
                "seconds": line["time/wall_seconds"],
                "env_steps": line["env_steps"],
                target.metric: line[f"eval/{target.metric}"],
            }
            for line in history
        ],
        "policy": report["policy"],
        "versions": versions,
        "output": printed.replace(folder, "").splitlines(),
    }


def _row(run: dict[str, Any], target: Target) -> str:
    policy = run["policy"]
    low, high = (target.format(policy[f"{target.name}_{end}"]) for end in ("low", "high"))
    reached = run["target_reached_seconds"]
    first_step = run["first_step_seconds"]
    return (
        f"| {run['seed']:>4} | {run['start']} | {run['process_seconds']:9.1f} s |"
        f" {run['compile_seconds']:7.1f} s |"
        f" {'-' if first_step is None else f'{first_step:.1f} s':>10} |"
        f" {'never' if reached is None else f'{reached:.1f} s':>8} |"
        f" {target.format(policy[target.metric]):>8} | {low} .. {high} |"
    )


def _parser() -> cli.Parser:
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", type=cli.positive_int, default=1, help="seeds 0 to N-1")
    targets = parser.add_mutually_exclusive_group()
    targets.add_argument("--target", type=cli.fraction, default=0.99, help="default: 0.99")
    targets.add_argument(
        "--target-return",
        type=float,
        metavar="X",
        help="the mean return to reach, of a configuration with an environment",
    )
    parser.add_argument("--warm", action="store_true", help="repeat with a warm cache")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all seeds, print the table and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if a seed's success rate or mean return in its report is below the target.
    """
    # Parse the command line and print the head of the table.
    options = _parser().parse_args(arguments)
    config = load_config(options.config, options.overrides)
    target = Target(SUCCESS, options.target)
    if options.target_return is not None:
        target = Target(RETURN, options.target_return)
    if config.environment is None and target.metric == RETURN:
        raise UserError(f"{options.config} has no environment: give --target, not --target-return")
    told = f"{target.value:.0%}" if target.metric == SUCCESS else f"{target.value:g}"
    print(
        " ".join([options.config.name, *options.overrides]) + "\n"
        f"| seed |start |     process |   compile | first step | ≥ {told} at |"
        f" {target.name:>8} |    95 % interval   |\n"
        "|-----:|:-----|------------:|----------:|-----------:|---------:|---------:"
        "|:------------------:|",
        flush=True,
    )
    # Measure; the file is written after every row, so that an interrupted run keeps its rows.
    options.output.parent.mkdir(parents=True, exist_ok=True)
    runs = []
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as cache:
            for _ in range(2 if options.warm else 1):
                run = measure(options.config, options.overrides, seed, target, Path(cache))
                runs.append(run)
                print(_row(run, target), flush=True)
                write_json(options.output, _results(options, config, target, runs))
    # Print the median times.
    machine = runs[0]["versions"]
    for start in dict.fromkeys(run["start"] for run in runs):
        seconds = [run["process_seconds"] for run in runs if run["start"] == start]
        print(
            f"{start}: median time of the process {statistics.median(seconds):.1f} s on"
            f" {machine['device_count']} x {machine['device']}, {available_cores()} CPU cores"
        )
    print(f"results: {options.output}")
    return 0 if all(target.is_reached(run["policy"]) for run in runs) else 1


def processor() -> str:
    """Return the model name of the host's processor."""
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    found = re.search(r"^model name\s*: (.*)$", text, re.MULTILINE)
    return found[1] if found else platform.processor() or platform.machine()


def _results(
    options: argparse.Namespace, config: Config, target: Target, runs: list[dict[str, Any]]
) -> dict[str, Any]:
    return {
        "command": f"train --config {options.config.absolute().parent.name}/{options.config.name}",
        "overrides": options.overrides,
        "metric": target.metric,
        "target": target.value,
        "cpu_cores": available_cores(),
        "processor": processor(),
        "config": config.model_dump(mode="json"),
        "runs": runs,
    }


if __name__ == "__main__":
    cli.run_command(main)
