"""Measure the latency of one action on one core, for each file of an exported policy.

    python benchmarks/throughput/action_latency.py runs/mine/policy

`jetbot-mjx export RUN --format all` writes the folder. Every call takes one observation,
which is one image if the policy sees, as on a robot, and includes the conversion from and to NumPy.
StableHLO is compiled by `jax.jit`.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jetbot_mjx.deployment.exporters import FORMATS, Act
from jetbot_mjx.deployment.policy_spec import FILE
from jetbot_mjx.errors import UserError, requires_extra

CALLS = 2000
_WARM_UP = 100


class Latency(NamedTuple):
    """A `Latency` holds the statistics of the time of one call [µs]."""

    name: str
    median: float
    p99: float
    worst: float


def measure(name: str, act: Act, inputs: Sequence[np.ndarray], calls: int = CALLS) -> Latency:
    """Time single calls of a policy.

    Args:
      name: The name of the row.
      act: The function from an observation to an action.
      inputs: The parts of n observations, each with a batch axis; every call takes the next one.
      calls: The number of timed calls after the warm-up.

    Returns:
      Median, 99th percentile and worst.
    """
    times = []
    for index in range(_WARM_UP + calls):
        row = index % len(inputs[0])
        parts = [part[row : row + 1] for part in inputs]
        start = time.perf_counter_ns()
        for output in act(*parts):
            np.asarray(output)
        times.append(1e-3 * (time.perf_counter_ns() - start))
    timed = np.array(times[_WARM_UP:])
    return Latency(name, *(float(np.percentile(timed, at)) for at in (50, 99, 100)))


def run(folder: Path, calls: int = CALLS) -> Iterator[Latency]:
    """Time every file of an export on the cores that this process may use.

    Args:
      folder: The folder of the export.
      calls: The number of timed calls for each file.

    Yields:
      One row for each file.

    Raises:
      UserError: The folder is not an export, or a package is missing.
    """
    try:
        spec = json.loads((folder / FILE).read_text("utf-8"))
        with np.load(folder / "recording.npz") as recording:
            inputs = [recording[one["name"]][:1000] for one in spec["inputs"]]
    except (OSError, ValueError, LookupError) as error:
        raise UserError(f"{folder} is not an export: {error}") from None
    for name, file in spec["files"].items():
        with requires_extra("export", f"--format {name}"):
            act = FORMATS[name].read(folder / file["file"])
        yield measure(name, act, inputs, calls)


def main(arguments: Sequence[str] | None = None) -> int:
    """Restrict the process to one core, time all files and print the table.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 2 after an error that the user can correct.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", type=Path, help="folder that jetbot_mjx.export wrote")
    parser.add_argument("--calls", type=int, default=CALLS, help=f"default: {CALLS}")
    options = parser.parse_args(arguments)
    cores = os.sched_getaffinity(0)
    try:
        # Threads that start later inherit the restriction.
        os.sched_setaffinity(0, {min(cores)})
        print(f"{'one action [µs]':16} {'median':>8} {'p99':>8} {'worst':>8}")
        for row in run(options.policy, options.calls):
            print(f"{row.name:16} {row.median:8.1f} {row.p99:8.1f} {row.worst:8.1f}")
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    finally:
        os.sched_setaffinity(0, cores)
    return 0


if __name__ == "__main__":
    sys.exit(main())
