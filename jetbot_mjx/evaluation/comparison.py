"""Compare several policies or trainings on the same goals, with intervals over seeds or episodes.

Intervals describe one of two kinds of randomness. The result of a training depends on its seed: if
a run has two seeds or more, intervals come from a bootstrap that resamples whole seeds within each
run. A run of one seed only shows how one policy performs on other goals, so its interval is over
episodes. Runs are also compared goal by goal, since all policies are evaluated on the same goals;
that comparison holds only for these policies, not for other trainings.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError, shown
from jetbot_mjx.evaluation import bootstrap_intervals as intervals
from jetbot_mjx.evaluation.bootstrap_intervals import FEW_SEEDS, Estimate, bootstrap
from jetbot_mjx.evaluation.curves import CurvePoint, band
from jetbot_mjx.evaluation.evaluator import Summary, json_values
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION
from jetbot_mjx.evaluation.report import Report
from jetbot_mjx.evaluation.result_names import path_from
from jetbot_mjx.runs import JsonObject, shortened


class _OfSeeds(Protocol):
    @property
    def seeds(self) -> Mapping[str, Any]: ...


_Run = TypeVar("_Run", bound=_OfSeeds)


class Aggregate(NamedTuple):
    """An `Aggregate` holds one quantity of one run."""

    over: Literal["seeds", "episodes"]
    """Whether the intervals are over seeds or over episodes."""
    count: int
    """Number of seeds or episodes that have a value."""
    mean: Estimate
    """Mean over seeds; for a single seed, its own value."""
    iqm: Estimate
    """Interquartile mean over seeds, without the best and the worst quarter; none for one seed."""


class Run(NamedTuple):
    """A `Run` holds the results of all seeds of one training."""

    name: str
    seeds: Mapping[str, Report]
    success_rate: Aggregate
    time_to_goal: Aggregate
    """[s] Aggregate of the medians of the seeds."""
    learning_curve: tuple[CurvePoint, ...]
    """Evaluations at the steps at which every seed was evaluated.

    Rates are means over the seeds; the interval is over seeds if there are at least two.
    """


class PairwiseResult(NamedTuple):
    """A `PairwiseResult` compares two runs, `a` and `b`, in one quantity."""

    difference: Estimate
    """Mean of `a` minus mean of `b`."""
    improvement: Estimate
    """Probability that a seed of `a` does better than one of `b`; equal seeds count half."""
    wins: int
    """Number of goals on which `a` did better."""
    losses: int
    """Number of goals on which `b` did better."""
    ties: int
    p: float
    """p-value of the exact two-sided binomial test that wins and losses are equally likely."""

    def told(self, form: str, what: str) -> str:
        """Return the result as text; of differences in a format, and wins on `what`."""
        return (
            f"difference {self.difference.told(form)},"
            f" improvement {self.improvement.told('{:.0%}')},"
            f" {what} {self.wins} : {self.losses} (p {self.p:.2g})"
        )


class Pair(NamedTuple):
    """A `Pair` compares two runs with each other."""

    a: str
    b: str
    seeds: int
    """Number of seeds of each run that are compared goal by goal. It is the same for both runs,
    counted from the first seed, because more seeds of one run would bias the comparison."""
    success_rate: PairwiseResult
    """Success rate; goal by goal, the run that reached the goal with more of its seeds wins."""
    time_to_goal: PairwiseResult
    """[s] Time to the goal, less is better; goal by goal for goals that both runs reached."""


class Comparison(NamedTuple):
    """A `Comparison` holds everything that is reported about several policies."""

    folder: Path
    """Folder of the comparison's files."""
    episodes: int
    settings: JsonObject
    """Settings of task, robot and time step, which all runs share."""
    runs: tuple[Run, ...]
    pairs: tuple[Pair, ...]
    differences: Mapping[str, Sequence[object]]
    """Values of each run, by key, for the settings in which runs differ besides the seed."""
    baselines: Mapping[str, Summary]
    versions: JsonObject

    def __repr__(self) -> str:
        """Return the mean success rate of each run and the folder in one line."""
        rates = {run.name: f"{run.success_rate.mean.value:.1%}" for run in self.runs}
        return f"Comparison(success={rates}, folder={str(shortened(self.folder))!r})"

    def to_json(self) -> JsonObject:
        """Return everything except the episodes as JSON values."""
        return comparison_json(self._asdict(), "policy", "mujoco", "best_known")


def comparison_json(values: JsonObject, *of_each_seed: str) -> JsonObject:
    """Return a comparison as JSON values.

    Args:
      values: the fields of the comparison.
      of_each_seed: the fields of each seed's report to keep.
    """
    folder = values["folder"]
    runs = [
        {
            **run._asdict(),
            "seeds": [
                {
                    "name": name,
                    "run": path_from(folder, report.checkpoint.parents[1]),
                    "checkpoint": report.checkpoint.name,
                    "env_steps": report.env_steps,
                    **{field: getattr(report, field) for field in of_each_seed},
                }
                for name, report in run.seeds.items()
            ],
        }
        for run in values["runs"]
    ]
    kept = {name: value for name, value in values.items() if name != "folder"}
    return json_values({"goal_set_version": GOAL_SET_VERSION, **kept, "runs": runs})


def common_fields(
    folder: Path, runs: Sequence[_Run], pair: Callable[[_Run, _Run], object]
) -> JsonObject:
    """Return the fields of a comparison that both kinds have, by name.

    Args:
      folder: the folder for the files of the comparison.
      runs: the results of each run.
      pair: a function that compares two of them.
    """
    firsts = [next(iter(run.seeds.values())) for run in runs]
    return {
        "folder": folder,
        "episodes": firsts[0].policy.episodes,
        "runs": tuple(runs),
        "pairs": tuple(pair(a, b) for a, b in itertools.combinations(runs, 2)),
        "differences": differing_settings([one.config for one in firsts]),
        "baselines": firsts[0].baselines,
        "versions": firsts[0].versions,
    }


def told_step_cost(comparison: Comparison) -> str:
    """Return what a step costs in the runs of a comparison, as a sentence without its full stop.

    Returns:
      The sentence, which names the runs where they differ; empty if no step costs anything.
    """
    costs = {
        run.name: next(iter(run.seeds.values())).config.task.step_cost for run in comparison.runs
    }
    if not any(costs.values()):
        return ""
    if len(set(costs.values())) == 1:
        return f"each step costs {max(costs.values()):g} m of the return"
    told = ", ".join(f"{cost:g} m in {name}" for name, cost in costs.items())
    return f"each step costs {told}, so the returns are not told beside each other"


def few_seeds_line(results: Iterable[Aggregate]) -> str:
    """Return a line about intervals over so few seeds that they mislead; empty without one.

    Args:
      results: one quantity of each run.
    """
    if not any(one.over == "seeds" and one.count < FEW_SEEDS for one in results):
        return ""
    return (
        "intervals over few seeds are too narrow: over two they hold the true value about every"
        " second time, and over equal seeds they have no width\n"
    )


def won_on(what: str, seeds: int, runs: Iterable[_OfSeeds]) -> str:
    """Return what is won and lost one by one, and of which seeds where not all of them count.

    Args:
      what: `goals` or `starts`.
      seeds: number of seeds of each run that are compared, counted from the first.
      runs: the runs that are compared.
    """
    if all(len(run.seeds) == seeds for run in runs):
        return what
    return f"{what} of the first {'seed' if seeds == 1 else f'{seeds} seeds'} of each"


def check_comparable(configs: Mapping[str, Config]) -> None:
    """Raise an error if runs did not train for the same task.

    Their observations, networks and training may differ, and the cost of a step, which changes
    neither what is reached nor how fast.

    Args:
      configs: the configuration of each run, by the name that the user gave.

    Raises:
      UserError: the runs differ in the task, the robot, or the duration of an episode.
    """
    settings = {name: _task_settings(config) for name, config in configs.items()}
    check_equal(settings, "one task and one robot")


def check_equal(settings: Mapping[str, JsonObject], what: str) -> None:
    """Raise an error if runs differ in settings.

    Args:
      settings: those of each run, by the name that the user gave.
      what: what the settings are of.

    Raises:
      UserError: they differ.
    """
    (first, wanted), *others = settings.items()
    for name, found in others:
        for key in {**wanted, **found}:
            if wanted.get(key) != found.get(key):
                raise UserError(
                    f"{name} cannot be compared with {first}: {key} = {shown(found.get(key))}, and"
                    f" not {shown(wanted.get(key))}; compare runs of {what}"
                )


def _task_settings(config: Config) -> JsonObject:
    """Return the settings of task, robot and time step, which compared runs must share."""
    return {
        key: value
        for key, value in config.flat().items()
        if key.startswith(("task.", "robot.", "physics.ctrl_dt"))
        and key not in ("task.observation", "task.step_cost")
    }


def differing_settings(configs: Sequence[Config]) -> dict[str, Sequence[object]]:
    """Return the values of each run, by key, for the settings in which runs differ.

    Args:
      configs: the configuration of each run.
    """
    flat = [config.flat() for config in configs]
    keys = dict.fromkeys(key for one in flat for key in one if key not in ("seed", "seeds"))
    found = {key: [one.get(key) for one in flat] for key in keys}
    return {key: values for key, values in found.items() if any(v != values[0] for v in values)}


def compare(folder: Path, runs: Mapping[str, Mapping[str, Report]]) -> Comparison:
    """Compare runs on the goals on which all of them were evaluated.

    Args:
      folder: the folder for the files of the comparison.
      runs: for each run by name, the report of each seed by name; all on the same goals.

    Returns:
      The comparison.

    Raises:
      UserError: their tasks sampled different goals from the same keys.
    """
    _check_goals(runs)
    rows = [_run(name, seeds) for name, seeds in runs.items()]
    config = next(iter(rows[0].seeds.values())).config
    settings = {"robot": config.robot.label, **_task_settings(config)}
    return Comparison(**common_fields(folder, rows, _pair), settings=settings)


def _check_goals(runs: Mapping[str, Mapping[str, Report]]) -> None:
    (first, wanted), *others = (
        (name, report.episodes.goal_w) for name, seeds in runs.items() for report in seeds.values()
    )
    for name, found in others:
        # Allow for a tolerance, because different compiled programs round differently.
        if not np.allclose(found, wanted, atol=1e-3):
            raise UserError(
                f"{name} cannot be compared with {first}: its task sampled other goals from the"
                " same keys; let `sample` depend on what the runs have in common alone"
            )


def _run(name: str, seeds: Mapping[str, Report]) -> Run:
    reports = list(seeds.values())
    if len(reports) == 1:
        success, time = _of_one_seed(reports[0])
    else:
        success = aggregate_seeds([one.policy.success_rate for one in reports])
        time = aggregate_seeds(_times(reports))
    return Run(name, seeds, success, time, band([one.learning_curve for one in reports]))


def _times(reports: Sequence[Report]) -> list[float]:
    """Return the median times to the goal of the seeds that reached any goal."""
    medians = (one.policy.time_to_goal_median for one in reports)
    return [median for median in medians if median is not None]


def _of_one_seed(report: Report) -> tuple[Aggregate, Aggregate]:
    """Return the success rate with its Wilson interval and the median time, over the episodes."""
    policy, episodes = report.policy, report.episodes
    success = Estimate(policy.success_rate, policy.success_low, policy.success_high)
    steps = np.asarray(episodes.steps)[np.asarray(episodes.success) > 0]
    time = intervals.median_estimate(steps * report.config.physics.ctrl_dt)
    return (
        Aggregate("episodes", policy.episodes, success, Estimate(None)),
        Aggregate("episodes", policy.successes, time, Estimate(None)),
    )


def aggregate_seeds(values: Sequence[float]) -> Aggregate:
    """Return a quantity of one run over its seeds.

    Args:
      values: the value of each seed.
    """
    return Aggregate(
        "seeds",
        len(values),
        bootstrap(np.mean, values),
        bootstrap(intervals.interquartile_mean, values),
    )


def _pair(a: Run, b: Run) -> Pair:
    ours, theirs = list(a.seeds.values()), list(b.seeds.values())
    seeds = min(len(ours), len(theirs))
    rate_a, steps_a = _success_by_goal(ours[:seeds])
    rate_b, steps_b = _success_by_goal(theirs[:seeds])
    both = (rate_a > 0) & (rate_b > 0)
    success = [[one.policy.success_rate for one in reports] for reports in (ours, theirs)]
    return Pair(
        a.name,
        b.name,
        seeds,
        compare_pairwise(success[0], success[1], rate_a > rate_b, rate_a < rate_b),
        compare_pairwise(
            _times(ours),
            _times(theirs),
            (steps_a < steps_b)[both],
            (steps_a > steps_b)[both],
            less_is_better=True,
        ),
    )


def _success_by_goal(
    reports: Sequence[Report],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return for each goal the fraction of seeds that reached it, and their mean steps."""
    won = np.stack([one.episodes.success > 0 for one in reports])
    # Add integers, so that equal values stay equal in whatever order they are added.
    steps = np.stack([np.asarray(one.episodes.steps, int) for one in reports])
    reached = won.sum(axis=0)
    return reached / len(reports), (won * steps).sum(axis=0) / np.maximum(reached, 1)


def compare_pairwise(
    a: Sequence[float],
    b: Sequence[float],
    better: Bool[np.ndarray, " n"],
    worse: Bool[np.ndarray, " n"],
    *,
    less_is_better: bool = False,
) -> PairwiseResult:
    """Compare two runs in one quantity.

    Args:
      a: the value of each seed of the first run.
      b: that of each seed of the second run.
      better: for each goal or start, whether the first run did better.
      worse: whether the second one did.
      less_is_better: whether a smaller value is better.
    """
    wins, losses = int(better.sum()), int(worse.sum())
    several = len(a) > 1 and len(b) > 1
    order = (b, a) if less_is_better else (a, b)
    return PairwiseResult(
        difference=bootstrap(intervals.mean_difference, a, b),
        # With a single seed the comparison says nothing about other seeds.
        improvement=bootstrap(intervals.probability_of_improvement, *order)
        if several
        else Estimate(None),
        wins=wins,
        losses=losses,
        ties=better.size - wins - losses,
        p=float(scipy.stats.binomtest(wins, wins + losses).pvalue) if wins + losses else 1.0,
    )
