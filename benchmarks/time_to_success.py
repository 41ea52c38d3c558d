"""Measures how long success takes: `python benchmarks/time_to_success.py --config FILE`.

For each seed a new process trains from a cold start (an empty compilation cache), and another
judges its best policy on the report's fixed goals; with `--warm` the same follows once more with
the cache as the first left it. The clock is that of whole processes, imports and compilation
included; what the trainer says of itself stands beside it. `--set trainer=brax` measures the
stock trainer.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import write_json

_FOLDER = Path(__file__).resolve().parent


def measure(
    config: Path, overrides: Sequence[str], seed: int, target: float, cache: Path
) -> dict[str, Any]:
    """Trains and judges one seed.

    Args:
      config: YAML file.
      overrides: as for `--set`.
      seed: of the run.
      target: success rate that the evaluations during training are watched for.
      cache: folder of compiled programs; cold where it is empty.

    Returns:
      Times, success and the two processes' own output, as JSON.

    Raises:
      UserError: one of the processes failed.
    """
    start = "warm" if cache.is_dir() and any(cache.iterdir()) else "cold"
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)}
        settings = [argument for override in overrides for argument in ("--set", override)]
        train = ["train", "--config", str(config), "--seed", str(seed), *settings]
        began = time.perf_counter()
        printed = _run([*train, "--run-dir", str(run_dir)], environment)
        seconds = time.perf_counter() - began
        printed += _run(["evaluate", str(run_dir)], environment)
        report = json.loads(next(run_dir.glob("evaluations/*/report.json")).read_text())
        lines = (run_dir / "metrics.jsonl").read_text().splitlines()
        history = [json.loads(line) for line in lines]
        # From the run: asking JAX here would take the GPU's memory away from the trainings.
        versions = json.loads((run_dir / "versions.json").read_text())
    reached = [line for line in history if line["eval/success_rate"] >= target]
    # What passes before the trainer's own clock starts is mostly imports.
    before = seconds - history[-1]["time/wall_seconds"]
    first_step = re.search(r"first training step done ([\d.]+) s", printed)
    return {
        "seed": seed,
        "start": start,
        "first_step_seconds": float(first_step[1]) if first_step else None,
        "process_seconds": seconds,
        "compile_seconds": sum(line["time/compile_seconds"] for line in history),
        "target_reached_seconds": before + reached[0]["time/wall_seconds"] if reached else None,
        "target_reached_steps": reached[0]["env_steps"] if reached else None,
        "policy": report["policy"],
        "versions": versions,
        "output": printed.replace(folder, "").splitlines(),
    }


def _run(command: Sequence[str], environment: dict[str, str]) -> str:
    module, *arguments = command
    done = subprocess.run(
        [sys.executable, "-m", f"jetbot_mjx.{module}", *arguments],
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise UserError(f"{module} failed: {(done.stderr.strip() or 'no word').splitlines()[-1]}")
    return done.stdout


def _row(run: dict[str, Any]) -> str:
    policy = run["policy"]
    reached = run["target_reached_seconds"]
    first_step = run["first_step_seconds"]
    return (
        f"| {run['seed']:>4} | {run['start']} | {run['process_seconds']:9.1f} s |"
        f" {run['compile_seconds']:7.1f} s |"
        f" {'-' if first_step is None else f'{first_step:.1f} s':>10} |"
        f" {'never' if reached is None else f'{reached:.1f} s':>8} |"
        f" {policy['success_rate']:8.2%} | {policy['success_low']:.2%} .."
        f" {policy['success_high']:.2%} |"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, measures, prints the table and writes the JSON file.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 1 where a seed's success rate on the fixed goals is below the target.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", type=cli.positive_int, default=1, help="seeds 0 to N-1")
    parser.add_argument("--target", type=cli.fraction, default=0.99, help="default: 0.99")
    parser.add_argument("--warm", action="store_true", help="once more with a warm cache")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    options = parser.parse_args(arguments)
    config = load_config(options.config, options.overrides)
    print(
        " ".join([options.config.name, *options.overrides]) + "\n"
        f"| seed |start |     process |   compile | first step | ≥ {options.target:.0%} at |"
        "  success |    95 % interval   |\n"
        "|-----:|:-----|------------:|----------:|-----------:|---------:|---------:"
        "|:------------------:|",
        flush=True,
    )
    options.output.parent.mkdir(parents=True, exist_ok=True)
    runs = []
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as cache:
            for _ in range(2 if options.warm else 1):
                run = measure(options.config, options.overrides, seed, options.target, Path(cache))
                runs.append(run)
                print(_row(run), flush=True)
                # After every row, so that what is cut short keeps what it had.
                write_json(options.output, _results(options, config, runs))
    machine = runs[0]["versions"]
    for start in dict.fromkeys(run["start"] for run in runs):
        seconds = [run["process_seconds"] for run in runs if run["start"] == start]
        print(
            f"{start}: median of the process's time {statistics.median(seconds):.1f} s on"
            f" {machine['device_count']} x {machine['device']}, {os.cpu_count()} CPU cores"
        )
    print(f"results: {options.output}")
    return 1 if any(run["policy"]["success_rate"] < options.target for run in runs) else 0


def _results(
    options: argparse.Namespace, config: Config, runs: list[dict[str, Any]]
) -> dict[str, Any]:
    return {
        "command": f"train --config configs/{options.config.name}",
        "overrides": options.overrides,
        "target": options.target,
        "cpu_cores": os.cpu_count(),
        "config": config.model_dump(mode="json"),
        "runs": runs,
    }


if __name__ == "__main__":
    cli.run_command(main)
