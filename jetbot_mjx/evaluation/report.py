"""Collect the content of a report on one policy (metrics, settings, failures) and its JSON.

Bearings are relative to the robot's heading at the start: 0° is straight ahead, positive is to the
left.
"""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jetbot_mjx.config import Config, RandomizationConfig
from jetbot_mjx.evaluation import best_known
from jetbot_mjx.evaluation.clips import Clip
from jetbot_mjx.evaluation.curves import CurvePoint, LossPoint
from jetbot_mjx.evaluation.evaluator import Summary, final_distances, json_values, success_and_time
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION, REPORT_GOALS
from jetbot_mjx.evaluation.moments import SeenEpisode, moments_as_json
from jetbot_mjx.evaluation.result_names import run_name
from jetbot_mjx.evaluation.robustness import MujocoResult, SweepResult, as_json
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.runs import JsonObject, RunChanges, shortened

TIME_LIMIT = "time limit"
ENDED_BY_TASK = "ended by the task"
NON_FINITE = "non-finite state"

SECTORS = 8
"""Number of sectors of the bearing, counter-clockwise; the first is centred straight ahead."""

_RINGS = 4
_EDGE_STEP = 0.05  # [m] step to which the edges of the rings are rounded

_SETTINGS = (
    "seed",
    "trainer",
    "physics.ctrl_dt",
    "ppo.num_timesteps",
    "ppo.network.policy_hidden_layer_sizes",
)
"""Settings of the configuration that a report shows, besides the robot and those of the task."""


class GoalBin(NamedTuple):
    """A `GoalBin` holds the results for the goals in one range of distances and bearings."""

    distance_low: float
    """[m] on the floor, from the start, like `distance_high`."""
    distance_high: float
    bearing_low: float
    """[°]; the sector behind the robot ends above 180°."""
    bearing_high: float
    episodes: int
    successes: int
    success_rate: float | None
    """None if the bin contains no goal, like its interval."""
    success_low: float | None
    """Lower end of the 95 % Wilson interval."""
    success_high: float | None
    """Upper end of the interval."""
    time_to_goal_median: float | None
    """[s] Median over the successes; None without a success."""


class Failure(NamedTuple):
    """A `Failure` describes a goal that was not reached."""

    goal: int
    """Index of the goal in the fixed set, from 0."""
    distance: float
    """[m] Distance from the start to the goal, on the floor."""
    bearing: float
    """[°] Bearing of the goal, in (-180, 180]."""
    final_distance: float
    """[m] Distance to the goal at the end, on the floor."""
    ended: str
    """`time limit`, `ended by the task`, or `non-finite state`."""
    replay: str | None
    """The command that renders the episode; None if the goal is beyond those that can be rendered.
    """


class TimeGap(NamedTuple):
    """A `TimeGap` compares a policy's time with the best-known time over the goals it reached."""

    bearing_low: float
    """[°] Lower limit of the goals' bearing; `bearing_high` is the upper limit."""
    bearing_high: float
    reached: int
    """Number of goals that the policy reached; if it is 0, the following fields are None."""
    policy_mean: float | None
    """[s] Mean time of the policy to these goals."""
    best_mean: float | None
    """[s] Mean of the best-known times to the same goals."""
    gap: float | None
    """`policy_mean` / `best_mean` - 1."""


class BestKnown(NamedTuple):
    """A `BestKnown` holds the best-known times to the report's goals and a policy's gap to them."""

    time_to_goal_median: float
    """[s] over all goals of the report, reached by the policy or not, like the next field."""
    time_to_goal_p95: float
    total: TimeGap
    by_direction: tuple[TimeGap, ...]
    """The gap in each sector of the bearing, counter-clockwise from straight ahead."""


class Report(NamedTuple):
    """A `Report` holds everything that is reported about one policy."""

    folder: Path
    """Folder of the report's files."""
    run: Path
    """The run folder, as it is written in commands."""
    checkpoint: Path
    env_steps: int
    config: Config
    policy: Summary
    baselines: Mapping[str, Summary]
    goal_bins: tuple[GoalBin, ...]
    failures: tuple[Failure, ...]
    learning_curve: tuple[CurvePoint, ...]
    """Evaluations during the training; empty if the run folder holds no metrics."""
    episodes: Episodes
    """The policy's episodes, with arrays on the host."""
    versions: JsonObject
    fallbacks: Sequence[tuple[str, str]] = ()
    """The parts of the training that ran slower than they could, each with the reason."""
    robustness: tuple[SweepResult, ...] = ()
    """Results on robots that differ from the preset; empty if they were not requested."""
    randomized: Summary | None = None
    """Metrics on the same goals with a robot sampled for each; None without ranges."""
    ranges: RandomizationConfig | None = None
    """The ranges that those robots were sampled from."""
    ranges_file: Path | None = None
    """The file that holds the ranges; None: the run's own configuration."""
    mujoco: MujocoResult | None = None
    """Metrics on the same goals in C MuJoCo; None if they were not requested."""
    best_known: BestKnown | None = None
    """Best-known times; None if there are none for these goals and settings."""
    best_known_missing: str | None = None
    """Why there are no best-known times."""
    lower_bound: BestKnown | None = None
    """Times below which no controller reaches the goals; None if there are none, like above."""
    lower_bound_missing: str | None = None
    """Why there is no such bound."""
    seen: tuple[SeenEpisode, ...] = ()
    """The images that the policy saw in some episodes; empty if it does not see."""
    clips: tuple[Clip, ...] = ()
    """Videos of some episodes; empty if none were requested, or none could be rendered."""
    clips_missing: str | None = None
    """Why no clips could be rendered."""
    changes: RunChanges | None = None
    """What the run changed from the one before it in the same folder; None without one."""
    losses: tuple[LossPoint, ...] = ()
    """Losses during the training; empty if the run folder holds none."""

    def __repr__(self) -> str:
        """Return the headline and the folder in one line."""
        return (
            f"Report(run={str(self.run)!r}, env_steps={self.env_steps},"
            f" success={self.policy.successes}/{self.policy.episodes},"
            f" folder={str(shortened(self.folder))!r})"
        )

    @property
    def name(self) -> str:
        """Return the readable name of the run; for a seed, with the folder that holds all seeds."""
        return run_name(self.checkpoint)

    def evaluate_command(self) -> str:
        """Return the command line that creates this report."""
        # `--robustness` alone evaluates in C MuJoCo too, but without pictures.
        asks_for_mujoco = self.mujoco and (self.mujoco.rendered is not None or not self.robustness)
        return (
            f"jetbot-mjx evaluate {shlex.quote(str(self.run))}"
            f" --checkpoint {self.env_steps} --episodes {self.policy.episodes}"
            f"{' --robustness' if self.robustness else ''}"
            f"{' --simulator mujoco' if asks_for_mujoco else ''}"
            f"{f' --ranges {shlex.quote(str(self.ranges_file))}' if self.ranges_file else ''}"
        )

    def to_json(self) -> JsonObject:
        """Return everything except the episodes and images as JSON values."""
        apart = ("folder", "config", "goal_bins", "episodes", "ranges_file")
        fields = {name: value for name, value in self._asdict().items() if name not in apart}
        converted = {
            "run": self.name,
            "checkpoint": self.checkpoint.name,
            "settings": {"robot": self.config.robot.label}
            | {
                key: value
                for key, value in self.config.flat().items()
                if key in _SETTINGS or key.startswith("task.")
            },
            "cells": self.goal_bins,
            "robustness": as_json(self.robustness) if self.robustness else None,
            "ranges": self.ranges.drawn if self.ranges else None,
            "seen": moments_as_json(self.seen) if self.seen else None,
            "clips": [{"goal": clip.goal, "reached": clip.reached} for clip in self.clips],
        }
        return json_values({"goal_set_version": GOAL_SET_VERSION, **fields, **converted})


def goal_positions(episodes: Episodes) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Compute the distance and bearing of each goal relative to the robot at the start.

    Args:
      episodes: episodes on the host.

    Returns:
      The distance on the floor [m], and the bearing in (-180, 180] [°].
    """
    x, y = np.asarray(episodes.goal_w[:, :2] - episodes.start_w, float).T
    bearing = np.degrees(np.arctan2(y, x) - np.asarray(episodes.start_yaw, float))
    return np.hypot(x, y), 180 - (180 - bearing) % 360


def by_goal(episodes: Episodes, ctrl_dt: float) -> tuple[GoalBin, ...]:
    """Compute success and time by the goal's distance and bearing.

    Args:
      episodes: episodes on the host.
      ctrl_dt: duration of one environment step [s].

    Returns:
      The bins in rings from the inner to the outer one, each counter-clockwise from straight ahead.
      The rings are equally wide and together contain all goals.
    """
    # Assign each goal to a ring of the distance and a sector of the bearing.
    distance, bearing = goal_positions(episodes)
    edges = _ring_edges(distance)
    ring = np.clip(np.digitize(distance, edges) - 1, 0, len(edges) - 2)
    sector = _sectors(bearing)
    won = np.asarray(episodes.success) > 0
    seconds = np.asarray(episodes.steps) * ctrl_dt
    bins = []
    for r in range(len(edges) - 1):
        for s in range(SECTORS):
            here = (ring == r) & (sector == s)
            limits = (edges[r], edges[r + 1], *_sector_limits(s))
            bins.append(GoalBin(*limits, **success_and_time(won[here], seconds[here])))
    return tuple(bins)


def _sector_limits(sector: int) -> tuple[float, float]:
    """Return the lowest and highest bearing of a sector [°]."""
    return (sector - 0.5) * 360 / SECTORS, (sector + 0.5) * 360 / SECTORS


def _sectors(bearing: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Return the sector that each bearing [°] lies in."""
    width = 360 / SECTORS
    return np.floor((bearing + width / 2) / width).astype(int) % SECTORS


def compare_times(config: Config, episodes: Episodes) -> dict[str, Any]:
    """Return a report's fields that compare its times with the best known and with the bound."""
    fields = {}
    kinds: Mapping[str, best_known.Kind] = {"best_known": "search", "lower_bound": "bound"}
    for name, kind in kinds.items():
        fields[name], fields[f"{name}_missing"] = compare_with(kind, config, episodes)
    return fields


def compare_with(
    kind: best_known.Kind, config: Config, episodes: Episodes
) -> tuple[BestKnown | None, str | None]:
    """Compare a policy's times with the best-known times, or with the bound below them.

    Args:
      kind: which of them, as for `best_known.find`.
      config: the configuration of the policy's run.
      episodes: the policy's episodes on the first goals of the report, with arrays on the host.

    Returns:
      The comparison and None, or None and the reason why there is no comparison.
    """
    steps = best_known.find(kind, config, episodes)
    if isinstance(steps, str):
        return None, steps
    best = steps * config.physics.ctrl_dt
    seconds = np.asarray(episodes.steps, float) * config.physics.ctrl_dt
    won, sector = np.asarray(episodes.success) > 0, _sectors(goal_positions(episodes)[1])

    def gap(low: float, high: float, here: np.ndarray) -> TimeGap:
        if not here.any():
            return TimeGap(low, high, 0, None, None, None)
        ours, theirs = float(seconds[here].mean()), float(best[here].mean())
        return TimeGap(low, high, int(here.sum()), ours, theirs, ours / theirs - 1)

    by_direction = tuple(gap(*_sector_limits(s), won & (sector == s)) for s in range(SECTORS))
    median, p95 = float(np.median(best)), float(np.percentile(best, 95))
    return BestKnown(median, p95, gap(-180.0, 180.0, won), by_direction), None


def _ring_edges(distance: Float[np.ndarray, " n"]) -> list[float]:
    # A goal that rounding moved across an edge still belongs to the adjacent ring.
    low = math.floor(distance.min() / _EDGE_STEP + 1e-4) * _EDGE_STEP
    high = math.ceil(distance.max() / _EDGE_STEP - 1e-4) * _EDGE_STEP
    # Goals at almost the same distance need only one ring.
    rings = _RINGS if high - low > _RINGS * _EDGE_STEP else 1
    return [
        round(float(edge), 4) for edge in np.linspace(low, max(high, low + _EDGE_STEP), rings + 1)
    ]


def find_failures(episodes: Episodes, run: Path, env_steps: int) -> tuple[Failure, ...]:
    """Return the goals that were not reached, in ascending order.

    Args:
      episodes: episodes on the host.
      run: the run folder, as it is written in commands.
      env_steps: environment steps of the checkpoint.

    Returns:
      One entry for each of these goals.
    """
    distance, bearing = goal_positions(episodes)
    remaining = final_distances(episodes)
    return tuple(
        Failure(
            goal=goal,
            distance=float(distance[goal]),
            bearing=float(bearing[goal]),
            final_distance=float(remaining[goal]),
            ended=_outcome(episodes, goal),
            replay=replay_command(run, env_steps, [goal]),
        )
        for goal in np.flatnonzero(~(np.asarray(episodes.success) > 0)).tolist()
    )


def _outcome(episodes: Episodes, goal: int) -> str:
    if episodes.nonfinite[goal] > 0:
        return NON_FINITE
    return ENDED_BY_TASK if episodes.terminated[goal] > 0 else TIME_LIMIT


def replay_command(run: Path, env_steps: int, goals: Sequence[int]) -> str | None:
    """Return the command line that renders a policy on some goals; None if none can be rendered."""
    which = ",".join(str(goal) for goal in goals if goal < REPORT_GOALS)
    if not which:
        return None
    return f"jetbot-mjx render {shlex.quote(str(run))} --checkpoint {env_steps} --goals {which}"
