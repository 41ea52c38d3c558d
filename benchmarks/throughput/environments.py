"""Measure environments with and without kernels: `python benchmarks/throughput/environments.py`.

Each environment is stepped in the wrappers of a training under random actions, drawn beforehand,
by kernels (`physics.impl: auto`) and by XLA alone, in turns. Without arguments these are
environments of three libraries, unchanged: Brax's inverted pendulum, MuJoCo Playground's
CartpoleBalance and Gymnax's Pendulum. One whose library is not installed is skipped, with one line
that says so:

    pip install --no-deps playground gymnax && pip install lxml six
"""

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.measurements import Sizes
from benchmarks.harness.results import (
    check_output,
    conditions,
    counts,
    default_output,
    output_for,
    write,
)
from benchmarks.harness.timing import (
    Carry,
    Tally,
    TimedProgram,
    add_tallies,
    env_keys,
)
from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import MissingPackageError, UserError
from jetbot_mjx.packed import pack

LIBRARIES: Mapping[str, Mapping[str, object]] = {
    "Brax inverted_pendulum": {
        "environment": "brax.envs:get_environment",
        "environment_options": {"env_name": "inverted_pendulum", "backend": "mjx"},
    },
    "Playground CartpoleBalance": {
        "environment": "mujoco_playground:registry.load",
        "environment_options": {
            "env_name": "CartpoleBalance",
            "config_overrides": {"impl": "jax"},
        },
    },
    "Gymnax Pendulum-v1": {
        "environment": "gymnax:make",
        "environment_options": {"env_id": "Pendulum-v1"},
    },
}
"""Settings of one environment of each library."""

_BATCHES = {"cpu": (256, 4_096), "gpu": (4_096, 65_536)}
_EPISODE_LENGTH = 200


class EnvironmentRow(NamedTuple):
    """An `EnvironmentRow` compares the two ways of one environment."""

    environment: str
    num_envs: int
    kernels: float
    """Environment steps per second by kernels, median of the repeats."""
    xla: float
    """The same by XLA alone."""
    ratio: float
    """The median of the ratios of each round."""
    kernels_compile_seconds: float
    xla_compile_seconds: float


def _prepare(config: Config, num_envs: int, sizes: Sizes) -> TimedProgram:
    """Compile the steps of an environment in the wrappers of a training."""
    env = make_env(config)
    batch = wrap_for_training(env, config.task.episode_length)
    shape = (sizes.unroll, num_envs, env.action_size)
    table = jax.random.uniform(jax.random.PRNGKey(0), shape, minval=-1.0)

    def step(carry: Carry) -> Carry:
        # The key counts the steps, whose actions repeat. The state is passed on as in a training.
        packed = batch.step_packed(carry.state, table[carry.key[1] % sizes.unroll])
        state = packed.unpack()
        ends, lost = state.info["episode_done"], state.metrics["nonfinite_envs"]
        tally = add_tallies(carry.tally, Tally(state.reward, ends, lost))
        return Carry(packed, carry.key + 1, tally)

    def check(rate: str, carry: Carry) -> None:
        if lost := int(carry.tally.nonfinite.sum()):
            raise UserError(f"{config.environment}: {lost} states were not finite")

    first = pack(jax.jit(batch.reset)(env_keys(num_envs)), batch_axes=1)
    return TimedProgram("env", step, first, n_substeps=1, calls=sizes.unroll, check=check)


def measure(name: str, config: Config, num_envs: int, sizes: Sizes) -> EnvironmentRow:
    """Time an environment both ways, in turns.

    Args:
      name: the name of the row.
      config: a configuration.
      num_envs: the number of environments.
      sizes: the number of repeats, and of steps in a call.
    """
    timed = []
    for impl in ("auto", "xla"):
        physics = config.physics.model_copy(update={"impl": impl})
        timed.append(_prepare(config.model_copy(update={"physics": physics}), num_envs, sizes))
    repeats = [[one.repeat() for one in timed] for _ in range(sizes.repeats)]
    rows = [one.row([rates[i] for rates in repeats]) for i, one in enumerate(timed)]
    ratio = statistics.median(kernels / xla for kernels, xla in repeats)
    kernels, xla = rows
    return EnvironmentRow(
        name,
        num_envs,
        kernels.env_steps_per_second,
        xla.env_steps_per_second,
        ratio,
        kernels.compile_seconds,
        xla.compile_seconds,
    )


def _configs(names: Sequence[str]) -> dict[str, Config]:
    if names:
        return {Path(name).stem: load_config(name) for name in names}
    task = {"episode_length": _EPISODE_LENGTH}
    return {name: parse_config({**one, "task": task}) for name, one in LIBRARIES.items()}


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", nargs="*", metavar="CONFIG", help="other configurations")
    parser.add_argument("--num-envs", type=counts, metavar="N,N,...")
    parser.add_argument("--repeats", type=cli.positive_int, default=5, help="rounds (default: 5)")
    parser.add_argument(
        "--output",
        type=Path,
        help="default: results/environments-<device>.json, none of other configurations",
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.

    Raises:
      UserError: A configuration is wrong, or the file cannot be written.
    """
    options = _parser().parse_args(arguments)
    stored = default_output("environments-")
    output = output_for(options.output, stored, is_own=bool(options.configs))
    check_output(output)
    sizes = Sizes(repeats=options.repeats)
    configs = _configs(options.configs)
    measured = conditions(next(iter(configs.values())), sizes)
    print(f"on {measured['device']} and {measured['cpu_cores']} CPU cores, steps per second")
    print("| environment | instances | kernels | XLA | ratio | compiled | by XLA |")
    print("|---|--:|--:|--:|--:|--:|--:|")
    rows = []
    for name, config in configs.items():
        for num_envs in options.num_envs or _BATCHES[jax.default_backend()]:
            try:
                row = measure(name, config, num_envs, sizes)
            except MissingPackageError as error:
                print(f"{name} is skipped: {error}", file=sys.stderr)
                break
            rows.append(row._asdict())
            print(
                f"| {name} | {num_envs:,} | {row.kernels:,.0f} | {row.xla:,.0f} |"
                f" {row.ratio:.1f} | {row.kernels_compile_seconds:.1f} s |"
                f" {row.xla_compile_seconds:.1f} s |",
                flush=True,
            )
    write(output, {**measured, "rows": rows})
    return 0


if __name__ == "__main__":
    cli.run_command(main)
