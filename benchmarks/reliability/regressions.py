"""Compare rates with those of an earlier file, measured under the same conditions."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.harness.timing import Row
from jetbot_mjx.errors import UserError

MOST_SLOWDOWN = 0.05
"""The relative loss above which a rate counts as slower."""

_SAME = ("device", "platform", "device_count", "cpu_cores", "xla_flags")
_SAME_CONDITIONS = ("unroll", "training_steps", "matmul_precision")


class Change(NamedTuple):
    """A `Change` holds one rate, before and after, in environment steps per second."""

    rate: str
    num_envs: int
    before: float
    after: float

    @property
    def relative(self) -> float:
        """Return the relative change of the rate; positive: faster."""
        return self.after / self.before - 1

    @property
    def is_slower(self) -> bool:
        """Return whether the loss is larger than `MOST_SLOWDOWN`."""
        return self.relative < -MOST_SLOWDOWN


def read_baseline(path: Path, conditions: Mapping[str, Any]) -> dict[tuple[str, int], float]:
    """Return the rates of an earlier file.

    Args:
      path: The path of the file.
      conditions: The conditions of the measurement that is compared with it.

    Returns:
      Environment steps per second by (rate, num_envs).

    Raises:
      UserError: The file contains no rates, or those of another device or configuration.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        found = {
            (row["rate"], row["num_envs"]): row["env_steps_per_second"] for row in values["results"]
        }
    except OSError as error:
        raise UserError(f"--compare {path} cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise UserError(
            f"--compare {path} contains no rates: give a file that steps_per_second.py wrote"
        ) from None
    for name, before, after in _differences(values, conditions):
        raise UserError(
            f"--compare {path} was measured with {name} = {before}, this is {after}: only rates"
            " of one device and one configuration can be compared"
        )
    return found


def changes(rows: Sequence[Row], baseline: Mapping[tuple[str, int], float]) -> list[Change]:
    """Return the changes of all rates that were measured both times."""
    return [
        Change(row.rate, row.num_envs, before, row.env_steps_per_second)
        for row in rows
        if (before := baseline.get((row.rate, row.num_envs))) is not None
    ]


def _differences(before: Any, after: Any) -> list[tuple[str, Any, Any]]:
    """Return (name, before, after) for each condition that must be equal and differs."""
    pairs = [(name, before.get(name), after[name]) for name in _SAME]
    old, new = before.get("conditions", {}), after["conditions"]
    pairs += [(name, old.get(name), new[name]) for name in _SAME_CONDITIONS]
    old, new = _flat(before.get("config", {})), _flat(after["config"])
    pairs += [(name, old.get(name), new.get(name)) for name in dict.fromkeys([*new, *old])]
    return [(name, one, other) for name, one, other in pairs if one != other]


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat
