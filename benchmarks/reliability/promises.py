"""Check what the README promises: `python benchmarks/reliability/promises.py --output FILE`.

Trains --seeds policies of one configuration. Each is trained once undisturbed, and once killed by
SIGKILL half-way and resumed by the same command: both must end bit-identically. Then each drives to
the 1,024 fixed goals, in training's simulator and in C MuJoCo. Everything runs on the CPU.
"""

import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from benchmarks.harness.timing import available_cores
from benchmarks.reliability.torture import Process, finish
from jetbot_mjx import cli, evaluate
from jetbot_mjx.config import load_config
from jetbot_mjx.evaluation import Report
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps
from jetbot_mjx.runs.run_dir import versions, write_json

CONFIG = "jetbot_egocentric"
LEAST = 0.99
"""Success that is promised in both simulators."""


class Row(NamedTuple):
    """A `Row` holds the results of one seed."""

    seed: int
    killed_after: int
    """Environment steps of the last checkpoint before the kill."""
    sha256: str
    sha256_resumed: str
    bit_identical: bool
    """Whether the whole training state and all metrics but times are the same, too."""
    success: float
    success_in_mujoco: float

    @property
    def kept(self) -> bool:
        """Return whether this seed keeps what is promised."""
        return self.bit_identical and min(self.success, self.success_in_mujoco) >= LEAST


def measure(seed: int, folder: Path, config: Path, episodes: int) -> Row:
    """Train with one seed, undisturbed and killed, and evaluate in both simulators.

    Args:
      seed: The seed.
      folder: An empty folder for the runs.
      config: The configuration.
      episodes: The number of goals.

    Raises:
      RecoveryError: A training failed.
    """
    settings = (f"seed={seed}",)
    run, killed = folder / "run", folder / "killed"
    undisturbed = finish(run, settings, config=config)
    half = checkpoint_steps(run)[-1] // 2
    with Process(killed, settings, config=config) as process:
        process.until(lambda: checkpoint_steps(killed)[-1:] >= [half])
        process.send(signal.SIGKILL)
        process.wait()
    killed_after = checkpoint_steps(killed)[-1]
    resumed = finish(killed, settings, config=config)
    report = evaluate(run, episodes=episodes, simulator="mujoco")
    assert isinstance(report, Report)
    assert report.mujoco is not None
    return Row(
        seed=seed,
        killed_after=killed_after,
        sha256=undisturbed.fingerprint,
        sha256_resumed=resumed.fingerprint,
        bit_identical=undisturbed == resumed,
        success=report.policy.success_rate,
        success_in_mujoco=report.mujoco.policy.success_rate,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all seeds, print a line for each and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if a seed does not keep what is promised.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", default=CONFIG, help=f"configuration (default: {CONFIG})")
    cli.add_count(parser, "--seeds", "number of seeds", default=3)
    cli.add_count(parser, "--episodes", "drive to the first N goals", default=1024)
    parser.add_argument("--output", type=Path, metavar="FILE", help="JSON file")
    options = parser.parse_args(arguments)
    jax.config.update("jax_platforms", "cpu")
    os.environ["JAX_PLATFORMS"] = "cpu"
    config, rows = CONFIGS / f"{options.config}.yaml", []
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as folder:
            row = measure(seed, Path(folder), config, options.episodes)
        rows.append(row)
        print(
            f"seed {seed}: success {row.success:.2%}, in C MuJoCo {row.success_in_mujoco:.2%},"
            f" killed after {row.killed_after:,} steps and resumed:"
            f" {'bit-identical' if row.bit_identical else 'DIFFERENT BITS'}",
            flush=True,
        )
    if options.output:
        values = {"versions": versions(), "cpu_cores": available_cores()}
        values |= {"config": load_config(config).model_dump(mode="json")}
        write_json(
            options.output,
            {**values, "episodes": options.episodes, "rows": [row._asdict() for row in rows]},
        )
    return 0 if all(row.kept for row in rows) else 1


if __name__ == "__main__":
    cli.run_command(main)
