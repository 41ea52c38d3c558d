"""Collect what is reported about policies of an environment of one's own: returns and lengths.

A report on one policy and a comparison of several are named tuples, each with its JSON. Intervals
of a comparison are over seeds or over episodes, as `comparison` explains.
"""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jetbot_mjx.config import Config
from jetbot_mjx.evaluation.bootstrap_intervals import Estimate
from jetbot_mjx.evaluation.comparison import (
    Aggregate,
    PairwiseResult,
    aggregate_seeds,
    check_equal,
    common_fields,
    compare_pairwise,
    comparison_json,
)
from jetbot_mjx.evaluation.curves import ReturnPoint, band
from jetbot_mjx.evaluation.evaluator import json_values
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION
from jetbot_mjx.evaluation.result_names import run_name
from jetbot_mjx.evaluation.returns import ReturnSummary
from jetbot_mjx.evaluation.rollout import ReturnEpisodes
from jetbot_mjx.runs import JsonObject, TaskCode, shortened

_SETTINGS = (
    "environment",
    "seed",
    "trainer",
    "task.episode_length",
    "ppo.num_timesteps",
    "ppo.num_envs",
    "ppo.learning_rate",
    "ppo.discounting",
    "ppo.network.policy_hidden_layer_sizes",
)
"""Settings of the configuration that a report shows, besides the environment's options."""


class ReturnReport(NamedTuple):
    """A `ReturnReport` holds everything that is reported about one policy."""

    folder: Path
    """Folder of the report's files."""
    run: Path
    """The run folder, as it is written in commands."""
    checkpoint: Path
    env_steps: int
    config: Config
    dt: float | None
    """Duration of one environment step [s]; None: the environment does not tell it."""
    policy: ReturnSummary
    baselines: Mapping[str, ReturnSummary]
    learning_curve: tuple[ReturnPoint, ...]
    """Evaluations during the training; empty if the run folder holds no metrics."""
    episodes: ReturnEpisodes
    """The policy's episodes, with arrays on the host."""
    versions: JsonObject
    fallbacks: Sequence[tuple[str, str]] = ()
    """The parts of the training that ran slower than they could, each with the reason."""

    def __repr__(self) -> str:
        """Return the headline and the folder in one line."""
        return (
            f"ReturnReport(run={str(self.run)!r}, env_steps={self.env_steps},"
            f" return={self.policy.episode_return:z.2f}, folder={str(shortened(self.folder))!r})"
        )

    @property
    def name(self) -> str:
        """Return the readable name of the run; for a seed, with the folder that holds all seeds."""
        return run_name(self.checkpoint)

    def evaluate_command(self) -> str:
        """Return the command line that creates this report."""
        return (
            f"jetbot-mjx evaluate {shlex.quote(str(self.run))}"
            f" --checkpoint {self.env_steps} --episodes {self.policy.episodes}"
        )

    def to_json(self) -> JsonObject:
        """Return everything as JSON values, of the policy's episodes return, length and end."""
        apart = ("folder", "config", "episodes")
        fields = {name: value for name, value in self._asdict().items() if name not in apart}
        found = self.episodes
        converted = {
            "run": self.name,
            "checkpoint": self.checkpoint.name,
            "environment": self.config.environment,
            "settings": {
                key: value
                for key, value in self.config.flat().items()
                if key in _SETTINGS or key.startswith("environment_options.")
            },
            "returns": np.asarray(found.episode_return, float).tolist(),
            "lengths": np.asarray(found.steps, int).tolist(),
            "terminated": (np.asarray(found.terminated) > 0).tolist(),
        }
        return json_values({"goal_set_version": GOAL_SET_VERSION, **fields, **converted})


class ReturnRun(NamedTuple):
    """A `ReturnRun` holds the results of all seeds of one training."""

    name: str
    seeds: Mapping[str, ReturnReport]
    episode_return: Aggregate
    """Aggregate of the mean returns of the seeds."""
    success_rate: Aggregate | None
    """None: the environment has no metric `success`."""
    learning_curve: tuple[ReturnPoint, ...]
    """Evaluations at the steps at which every seed was evaluated, as means over the seeds; the
    interval is over seeds if there are at least two."""


class ReturnPair(NamedTuple):
    """A `ReturnPair` compares two runs with each other, start by start."""

    a: str
    b: str
    seeds: int
    """Number of seeds of each run that are compared start by start, counted from the first."""
    episode_return: PairwiseResult


class ReturnComparison(NamedTuple):
    """A `ReturnComparison` holds everything that is reported about several policies."""

    folder: Path
    """Folder of the comparison's files."""
    episodes: int
    environment: str
    runs: tuple[ReturnRun, ...]
    pairs: tuple[ReturnPair, ...]
    differences: Mapping[str, Sequence[object]]
    """Values of each run, by key, for the settings in which runs differ besides the seed."""
    other_code: Sequence[str]
    """One line for each run whose environment has other code than that of the first."""
    baselines: Mapping[str, ReturnSummary]
    versions: JsonObject

    def __repr__(self) -> str:
        """Return the mean return of each run and the folder in one line."""
        means = {run.name: f"{run.episode_return.mean.value:z.2f}" for run in self.runs}
        return f"ReturnComparison(return={means}, folder={str(shortened(self.folder))!r})"

    def to_json(self) -> JsonObject:
        """Return everything except the episodes as JSON values."""
        return comparison_json(self._asdict(), "policy")


def check_one_environment(configs: Mapping[str, Config]) -> None:
    """Raise an error if the returns of runs cannot be compared.

    Args:
      configs: the configuration of each run, by the name that the user gave.

    Raises:
      UserError: the runs differ in the environment, its options or the length of an episode.
    """
    settings = {
        name: {
            "environment": config.environment,
            "environment_options": config.environment_options,
            "task.episode_length": config.task.episode_length,
        }
        for name, config in configs.items()
    }
    check_equal(settings, "one environment")


def compare_code(codes: Mapping[str, TaskCode | None]) -> tuple[str, ...]:
    """Tell which runs have an environment of the same name and of other code.

    Args:
      codes: the source that each run stored, by the name of the run.

    Returns:
      One line for each run that differs from the first, with the files that do.
    """
    files = {name: dict(code.files) if code else {} for name, code in codes.items()}
    (first, wanted), *others = files.items()
    lines = []
    for name, found in others:
        paths = sorted(path for path in {*wanted, *found} if wanted.get(path) != found.get(path))
        if paths:
            # A file that both have is not the same; another one is of one of them alone.
            told = ", ".join(
                f"{path} differs"
                if path in wanted and path in found
                else f"only {first if path in wanted else name} has {path}"
                for path in paths
            )
            lines.append(
                f"the environments of {first} and {name} are not the same code: {told}: their"
                " returns may not be comparable"
            )
    return tuple(lines)


def compare_returns(
    folder: Path,
    runs: Mapping[str, Mapping[str, ReturnReport]],
    other_code: Sequence[str] = (),
) -> ReturnComparison:
    """Compare runs on the starts on which all of them were evaluated.

    Args:
      folder: the folder for the files of the comparison.
      runs: for each run by name, the report of each seed by name; all on the same starts.
      other_code: a result of `compare_code`.
    """
    rows = [_run(name, seeds) for name, seeds in runs.items()]
    environment = next(iter(rows[0].seeds.values())).config.code
    return ReturnComparison(
        **common_fields(folder, rows, _pair), environment=environment, other_code=other_code
    )


def _run(name: str, seeds: Mapping[str, ReturnReport]) -> ReturnRun:
    reports = list(seeds.values())
    policies = [one.policy for one in reports]
    rates = [one.success_rate for one in policies if one.success_rate is not None]
    curve = band([one.learning_curve for one in reports])
    if len(reports) > 1:
        success = aggregate_seeds(rates) if rates else None
        returns = aggregate_seeds([one.episode_return for one in policies])
        return ReturnRun(name, seeds, returns, success, curve)
    (one,) = policies
    mean = Estimate(one.episode_return, one.return_low, one.return_high)
    rate = Estimate(one.success_rate, one.success_low, one.success_high)
    return ReturnRun(
        name,
        seeds,
        Aggregate("episodes", one.episodes, mean, Estimate(None)),
        Aggregate("episodes", one.episodes, rate, Estimate(None)) if rates else None,
        curve,
    )


def _pair(a: ReturnRun, b: ReturnRun) -> ReturnPair:
    ours, theirs = list(a.seeds.values()), list(b.seeds.values())
    seeds = min(len(ours), len(theirs))
    means = [[one.policy.episode_return for one in reports] for reports in (ours, theirs)]
    here, there = (
        np.mean([one.episodes.episode_return for one in reports[:seeds]], axis=0)
        for reports in (ours, theirs)
    )
    result = compare_pairwise(means[0], means[1], here > there, here < there)
    return ReturnPair(a.name, b.name, seeds, result)
