"""Predict the memory of a training, for the configuration and for other numbers of environments."""

from typing import NamedTuple

import jax

from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup
from jetbot_mjx.terminal import text_table
from jetbot_mjx.training.memory import GIB, Footprint, MemoryModel, device_memory, sizes
from jetbot_mjx.training.ppo_trainer import build_ppo


class MemoryPlan(NamedTuple):
    """A `MemoryPlan` holds the memory that a training needs and the memory of each device."""

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

    @property
    def fits(self) -> bool:
        """Return whether the configuration fits as it is."""
        asked = self.config.ppo.num_envs
        return next(one for one in self.footprints if one.num_envs == asked).total <= self.limit


def plan_memory(config: Config, memory: float | None = None) -> MemoryPlan:
    """Predict the memory of a training from shapes alone, without compiling anything.

    Args:
      config: The configuration of the run.
      memory: The memory of each device [GiB], or None for what the first device reports.

    Returns:
      The needed memory by the number of environments.

    Raises:
      UserError: the devices cannot share the environments, or do not report their memory.
    """
    device_count = jax.device_count()
    config.check_devices(device_count)
    limit = device_memory() if memory is None else int(memory * GIB)
    if limit is None:
        raise UserError("this device does not report its memory: give --memory GIB")
    setup = Setup(config)
    model = MemoryModel(config, sizes(build_ppo(setup), setup.env), device_count)
    return MemoryPlan(config, device_count, limit, model.ladder(limit))


def memory_table(plan: MemoryPlan) -> str:
    """Return a plan as a table for the terminal."""
    parts = ("parameters", "environments", "collecting", "learning", "evaluation")
    rows = [("", "num_envs", "batch_size", *parts, "needed", "")]
    rows += [
        (
            ">" if one.num_envs == plan.config.ppo.num_envs else "",
            f"{one.num_envs:,}",
            f"{one.batch_size:,}",
            *(f"{getattr(one, part) / GIB:.3f}" for part in parts),
            f"{one.total / GIB:.3f}",
            "" if one.total <= plan.limit else "does not fit",
        )
        for one in plan.footprints
    ]
    remedy = "none of them fits: try a smaller network or evaluation.episodes"
    if best := plan.largest:
        remedy = f"the largest of these that fits: {best.settings}"
    return (
        f"GiB on each of {plan.device_count} x {jax.devices()[0].device_kind},"
        f" which has {plan.limit / GIB:.1f}; > marks the configuration\n"
        f"{text_table(rows)}\n{remedy}"
    )
