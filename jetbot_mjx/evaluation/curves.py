"""Read the learning curves of trainings from their metrics, and combine those of several seeds."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from jetbot_mjx.evaluation.bootstrap_intervals import bootstrap_interval
from jetbot_mjx.runs import History


class CurvePoint(NamedTuple):
    """A `CurvePoint` holds one evaluation during the training, on goals common to all of them."""

    env_steps: int
    success_rate: float
    success_low: float
    success_high: float
    time_to_goal_median: float | None = None
    """[s] Median over the successes; None without a success, and in a curve over several seeds."""


class ReturnPoint(NamedTuple):
    """A `ReturnPoint` holds one evaluation during the training, on starts common to all of them."""

    env_steps: int
    episode_return: float
    return_low: float
    """Lower end of the 95 % interval of the mean."""
    return_high: float
    """Upper end of the interval."""


class LossPoint(NamedTuple):
    """A `LossPoint` holds the losses of one line of the training's metrics."""

    env_steps: int
    policy: float
    value: float
    kl: float
    """Kullback-Leibler divergence of the policy from the one that collected the data."""


_Point = TypeVar("_Point", CurvePoint, ReturnPoint, LossPoint)
_METRICS = {"policy": "loss/policy", "value": "loss/value", "kl": "policy/kl"}
"""Metrics of the fields that are of no evaluation."""


def read_curve(kind: type[_Point], history: Iterable[History]) -> tuple[_Point, ...]:
    """Extract a curve from the metrics of a training.

    Args:
      kind: what its points hold.
      history: the lines of `metrics.jsonl`.

    Returns:
      One point for each line that holds all metrics but those whose field has a default.
    """
    points = []
    for line in history:
        found = {
            name: line.metrics.get(_METRICS.get(name, f"eval/{name}")) for name in kind._fields[1:]
        }
        known = {name: value for name, value in found.items() if value is not None}
        if {*kind._fields[1:]} - known.keys() <= kind._field_defaults.keys():
            points.append(kind(line.env_steps, **known))
    return tuple(sorted(points, key=lambda point: point.env_steps))


def band(curves: Sequence[Sequence[_Point]]) -> tuple[_Point, ...]:
    """Return the learning curve over seeds, at the steps that the curves of all seeds share.

    Args:
      curves: the curve of each seed.

    Returns:
      The curve of a single seed as it is; of several seeds their means, with intervals over seeds.
    """
    if len(curves) == 1:
        return tuple(curves[0])
    by_steps = [{point[0]: point[1] for point in curve} for curve in curves]
    common = sorted(set.intersection(*(set(curve) for curve in by_steps)))
    if not common:
        return ()
    values = np.array([[curve[step] for step in common] for curve in by_steps])
    lows, highs = bootstrap_interval(np.mean, [values], axis=0)
    columns = (common, values.mean(axis=0), lows, highs)
    kind = type(curves[0][0])
    return tuple(
        kind(int(step), float(mean), float(low), float(high))
        for step, mean, low, high in zip(*columns, strict=True)
    )
