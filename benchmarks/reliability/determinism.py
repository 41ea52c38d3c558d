"""Check determinism: `python benchmarks/reliability/determinism.py --config configs/gpu.yaml`.

Trains one seed in several processes: twice with `deterministic: false`, twice with
`deterministic: true`, and once more with `deterministic: true` to half the steps and then, resumed,
to the end. Prints the SHA-256 of the final parameters, and the cost of determinism in environment
steps/s (median over the intervals of each run, without compilation and evaluation).
"""

import json
import re
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.processes import run_module
from benchmarks.harness.timing import available_cores
from jetbot_mjx import cli
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import write_json


class Row(NamedTuple):
    """A `Row` holds the result of one training."""

    name: str
    sha256: str
    env_steps_per_second: float


def measure(name: str, run_dir: Path, *trainings: Sequence[str]) -> Row:
    """Train in one run folder.

    Args:
      name: The name of the row.
      run_dir: The run folder.
      trainings: The arguments of each process, one after the other.

    Returns:
      The hash that the last process printed, and the rate over all processes.

    Raises:
      UserError: A training failed.
    """
    printed = ""
    for arguments in trainings:
        printed = run_module("train", arguments)
    lines = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    rates = [line["time/env_steps_per_second"] for line in lines if line["env_steps"]]
    found = re.search(r"sha256 ([0-9a-f]{64})", printed)
    if found is None:
        raise UserError("training printed no sha256")
    return Row(name, found[1], statistics.median(rates))


def main(arguments: Sequence[str] | None = None) -> int:
    """Train all variants, print their hashes and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if deterministic trainings differ.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    # Half the steps must end at a checkpoint, and the learning rate must not depend on the end.
    overrides = [*options.overrides, "ppo.learning_rate_schedule=ADAPTIVE_KL"]
    config = load_config(options.config, overrides)
    intervals = config.ppo.num_timesteps // config.checkpoint_interval
    half = f"ppo.num_timesteps={config.checkpoint_interval * (intervals // 2)}"
    whole = f"ppo.num_timesteps={config.checkpoint_interval * intervals}"

    def training(run_dir: Path, *more: str) -> list[str]:
        settings = [part for one in (*overrides, *more) for part in ("--set", one)]
        return ["--config", str(options.config), "--run-dir", str(run_dir), *settings]

    # Train all variants.
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number, name in enumerate(["default", "default", "deterministic", "deterministic"]):
            run_dir = Path(folder) / str(number)
            setting = f"deterministic={'true' if name == 'deterministic' else 'false'}"
            rows.append(measure(name, run_dir, training(run_dir, whole, setting)))
            print(_line(rows[-1]), flush=True)
        run_dir = Path(folder) / "resumed"
        begun = training(run_dir, half, "deterministic=true")
        resumed = ["--resume", str(run_dir), "--set", whole]
        rows.append(measure("deterministic, resumed", run_dir, begun, resumed))
        print(_line(rows[-1]))
        versions = json.loads((run_dir / "versions.json").read_text())
    # Compare hashes and rates.
    rates = [
        statistics.median(row.env_steps_per_second for row in pair)
        for pair in (rows[:2], rows[2:4])
    ]
    same = len({row.sha256 for row in rows[2:]}) == 1
    print(
        f"deterministic: {'bit-identical' if same else 'DIFFERENT BITS'}, {rates[1] / rates[0]:.2f}"
        f" x the speed of the default, on {versions['device_count']} x {versions['device']},"
        f" {available_cores()} CPU cores"
    )
    if options.output:
        values = {"versions": versions, "config": config.model_dump(mode="json")}
        write_json(options.output, {**values, "rows": [row._asdict() for row in rows]})
    return 0 if same else 1


def _line(row: Row) -> str:
    return f"{row.name:22}  {row.env_steps_per_second:12,.0f} steps/s  {row.sha256}"


if __name__ == "__main__":
    cli.run_command(main)
