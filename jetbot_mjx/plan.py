"""Tells what memory a training takes: `python -m jetbot_mjx.plan --config configs/gpu.yaml`.

On each device, for more and for fewer environments, from shapes alone: nothing is compiled and
nothing trained.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.training.memory import GIB, Footprint, device_memory, ladder, sizes
from jetbot_mjx.training.ppo_trainer import build_ppo


class Plan(NamedTuple):
    """A `Plan` holds the memory that a configuration needs and the memory of each device."""

    config: Config
    device_count: int
    limit: int
    """Memory of each device [bytes]."""
    footprints: list[Footprint]
    """Memory footprints in ascending order of the number of environments."""

    @property
    def largest(self) -> Footprint | None:
        """Return the largest footprint that fits, or None."""
        return max((one for one in self.footprints if one.total <= self.limit), default=None)


def run(config: Config, memory: float | None = None) -> Plan:
    """Predict the memory of a training.

    Args:
      config: the configuration of the run.
      memory: memory of each device [GiB]; None: as the first device reports it.

    Returns:
      The needed memory by the number of environments.

    Raises:
      UserError: the devices cannot share the environments, or do not report their memory.
    """
    device_count = jax.device_count()
    config.check_devices(device_count)
    limit = device_memory() if memory is None else int(memory * GIB)
    if limit is None:
        raise UserError("this device does not tell its memory: give --memory GIB")
    env = make_env(config)
    each = sizes(build_ppo(config, env), env)
    return Plan(config, device_count, limit, ladder(config, each, device_count, limit))


def table(plan: Plan) -> str:
    """Return a plan as a table for the terminal."""
    parts = ("parameters", "environments", "collecting", "learning", "evaluation")
    lines = [
        f"GiB on each of {plan.device_count} x {jax.devices()[0].device_kind},"
        f" which has {plan.limit / GIB:.1f}; > marks the configuration",
        f"  {'num_envs':>10}  {'batch_size':>10}  "
        + "  ".join(f"{one:>12}" for one in parts)
        + f"  {'needed':>8}",
    ]
    for one in plan.footprints:
        mark = ">" if one.num_envs == plan.config.ppo.num_envs else " "
        values = "  ".join(f"{getattr(one, part) / GIB:12.3f}" for part in parts)
        fits = "" if one.total <= plan.limit else "  does not fit"
        lines.append(
            f"{mark} {one.num_envs:10,}  {one.batch_size:10,}  {values}"
            f"  {one.total / GIB:8.3f}{fits}"
        )
    if (best := plan.largest) is None:
        return "\n".join(
            [*lines, "none of them fits: try a smaller network or evaluation.episodes"]
        )
    settings = f"--set ppo.num_envs={best.num_envs} --set ppo.batch_size={best.batch_size}"
    return "\n".join([*lines, f"the largest of these that fits: {settings}"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and predict the memory.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0, or 1 where the configuration does not fit as it is.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.plan", description=__doc__)
    parser.add_argument("--config", type=Path, required=True, help="YAML file, see configs/")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override one setting; may be given again",
    )
    parser.add_argument(
        "--memory", type=cli.positive_float, metavar="GIB", help="default: what the device has"
    )
    options = parser.parse_args(arguments)
    config = load_config(options.config, options.overrides)
    cli.require_device()
    use_compilation_cache()
    plan = run(config, options.memory)
    print(table(plan))
    asked = next(one for one in plan.footprints if one.num_envs == config.ppo.num_envs)
    return 0 if asked.total <= plan.limit else TOO_LARGE


TOO_LARGE = 1
"""Exit code: the configuration does not fit."""


if __name__ == "__main__":
    cli.run_command(main)
