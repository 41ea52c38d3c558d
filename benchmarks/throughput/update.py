"""Compare the updates of PPO: `python benchmarks/throughput/update.py --num-envs 4096,65536`.

Times training steps with `ppo.update: xla` and `fused` in turns, and prints for both the kernels in
which a training step spends its time, by the profiler of JAX. It needs an NVIDIA GPU.
"""

import argparse
import collections
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from benchmarks.harness.measurements import Sizes, training_config
from benchmarks.harness.results import counts
from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.devices import require_device
from jetbot_mjx.runs import Setup
from jetbot_mjx.training.ppo_trainer import CompiledTrainer

UPDATES = ("xla", "fused")


class KernelTime(NamedTuple):
    """A `KernelTime` holds the launches of a kernel in a training step, and their time."""

    name: str
    launches: float
    microseconds: float


class Training:
    """A compiled training that continues with every call."""

    def __init__(self, config: Config, update: str) -> None:
        """Compile.

        Args:
          config: The configuration of the run.
          update: The value of `ppo.update`.
        """
        ppo = config.ppo.model_copy(update={"update": update})
        config = config.model_copy(update={"ppo": ppo})
        program = CompiledTrainer.from_setup(Setup(config))
        self._advance, self._state = program.compile(), program.init()
        self.size = ppo.steps_per_training_step
        self.seconds(2)  # warm-up

    def seconds(self, steps: int) -> float:
        """Return the time of some training steps [s]."""
        start = time.perf_counter()
        self._state, _ = jax.block_until_ready(self._advance(self._state, steps, False))
        return time.perf_counter() - start

    def kernels(self, steps: int) -> list[KernelTime]:
        """Return the kernels of a training step, the longest first."""
        with tempfile.TemporaryDirectory() as folder:
            with jax.profiler.trace(folder):
                self.seconds(steps)
            (path,) = Path(folder).rglob("*.xplane.pb")
            return kernel_times(jax.profiler.ProfileData.from_file(str(path)), steps)


def kernel_times(profile: Any, steps: int) -> list[KernelTime]:
    """Return the kernels in a profile of a GPU, the longest first.

    Args:
      profile: The profile, from `jax.profiler.ProfileData`.
      steps: The number of training steps in it.
    """
    launches: collections.Counter[str] = collections.Counter()
    time_: collections.Counter[str] = collections.Counter()
    for plane in profile.planes:
        for line in plane.lines if "GPU" in plane.name else ():
            for event in line.events if line.name.startswith("Stream") else ():
                launches[event.name] += 1
                time_[event.name] += int(event.duration_ns)
    return [
        KernelTime(name, launches[name] / steps, nanoseconds / steps / 1e3)
        for name, nanoseconds in time_.most_common()
    ]


def measure(config: Config, sizes: Sizes, lines: int) -> Mapping[str, list[float]]:
    """Time training steps with both updates in turns, and print their kernels.

    Args:
      config: The configuration of the run.
      sizes: The number of rounds, and of training steps in each.
      lines: The number of kernels that are printed.

    Returns:
      Environment steps per second of each round, by update.
    """
    trainings = {update: Training(config, update) for update in UPDATES}
    rates: dict[str, list[float]] = {update: [] for update in UPDATES}
    for _ in range(sizes.repeats):
        for update, training in trainings.items():
            steps = training.size * sizes.training_steps
            rates[update].append(steps / training.seconds(sizes.training_steps))
    for update, training in trainings.items() if lines else ():
        kernels = training.kernels(sizes.training_steps)
        total = sum(kernel.microseconds for kernel in kernels)
        launches = sum(kernel.launches for kernel in kernels)
        print(f"{update}: {launches:,.0f} launches and {total:,.0f} us in a training step")
        for kernel in kernels[:lines]:
            print(f"{kernel.microseconds:10,.0f} us {kernel.launches:8,.0f} x {kernel.name[:60]}")
    return rates


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, default=CONFIGS / "gpu.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--num-envs", type=counts, default=(4096, 65536), metavar="N,N,...")
    parser.add_argument("--repeats", type=cli.positive_int, default=5, help="rounds (default: 5)")
    parser.add_argument("--training-steps", type=cli.positive_int, default=16)
    parser.add_argument(
        "--kernels", type=int, default=12, help="kernels that are printed (default: 12; 0: none)"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print the table.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0.
    """
    options = _parser().parse_args(arguments)
    config = load_config(options.config, options.overrides)
    require_device()
    sizes = Sizes(options.repeats, training_steps=options.training_steps)
    rows = []
    for num_envs in options.num_envs:
        rates = measure(
            training_config(config, num_envs, sizes, "resumable"), sizes, options.kernels
        )
        for update, values in rates.items():
            rate = statistics.median(values)
            spread = f"{min(values) / rate - 1:+.1%} .. {max(values) / rate - 1:+.1%}"
            rows.append(
                f"{num_envs:>9,}  {update:5}  {rate / 1e6:8.2f} M steps/s"
                f"  {1e6 * num_envs / rate:9,.0f} us/step  {spread}"
            )
    print("\n".join(rows))
    return 0


if __name__ == "__main__":
    cli.run_command(main)
