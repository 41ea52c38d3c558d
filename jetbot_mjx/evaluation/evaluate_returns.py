"""Evaluate policies of an environment of one's own on fixed starts, and write their reports."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import jax

from jetbot_mjx import runs
from jetbot_mjx.envs import AdaptedEnv
from jetbot_mjx.evaluation.curves import ReturnPoint, read_curve
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.evaluation.goal_set import REPORT_GOALS
from jetbot_mjx.evaluation.html_report import write_comparison, write_return_report
from jetbot_mjx.evaluation.result_names import comparison_folder, name_with_count
from jetbot_mjx.evaluation.return_report import (
    ReturnComparison,
    ReturnReport,
    check_one_environment,
    compare_code,
    compare_returns,
)
from jetbot_mjx.evaluation.returns import ReturnEvaluator, return_baselines, summarize_returns
from jetbot_mjx.runs import Checkpoint, Setup, check_writable, read_task_code
from jetbot_mjx.terminal import stage

_FOLDER = "evaluations"
_Report = TypeVar("_Report")


def write_returns(
    checkpoint: Checkpoint, episodes: int = REPORT_GOALS, output: str | Path | None = None
) -> ReturnReport:
    """Evaluate one policy and write its report.

    Args:
      checkpoint: the policy of a run with an `environment`.
      episodes: the number of fixed starts, from the first on.
      output: the folder of the report; None: one in `evaluations/` of the run folder.

    Returns:
      The report, which names its folder.

    Raises:
      UserError: the environment cannot be built, or the folder cannot be written.
    """
    folder = Path(output or _report_folder(checkpoint, episodes))
    check_writable(folder)
    return _Reporter(episodes).write(checkpoint, checkpoint.make_setup(), folder)


def compare_return_runs(
    entries: Mapping[str, Mapping[str, Checkpoint]],
    folder: Path,
    episodes: int = REPORT_GOALS,
    output: str | Path | None = None,
) -> ReturnComparison:
    """Evaluate the policies of several runs or seeds, write a report on each, and compare them.

    Args:
      entries: the policy of each seed by name, of each run by name.
      folder: the folder of the first run.
      episodes: the number of fixed starts, from the first on.
      output: the folder of the comparison; None: one in `evaluations/` of the first run.

    Returns:
      The comparison, which names its folder. Each of its reports names its own.

    Raises:
      UserError: the runs have different environments, an environment cannot be built, or a folder
        cannot be written.
    """
    firsts = {name: next(iter(seeds.values())) for name, seeds in entries.items()}
    check_one_environment({name: one.config for name, one in firsts.items()})
    name = name_with_count("comparison", episodes, REPORT_GOALS, "-episodes")
    folder = Path(output or comparison_folder(folder / _FOLDER, name, entries))
    reporter = _Reporter(episodes)

    def place_of(checkpoint: Checkpoint) -> Path:
        return _report_folder(checkpoint, episodes)

    def write(checkpoint: Checkpoint, setup: Setup) -> ReturnReport:
        return reporter.write(checkpoint, setup, place_of(checkpoint))

    by_run = report_each(entries, folder, place_of, write)
    code = compare_code({name: read_task_code(one.run_dir) for name, one in firsts.items()})
    comparison = compare_returns(folder.absolute(), by_run, code)
    with stage("writing the comparison"):
        write_comparison(comparison)
    return comparison


def report_each(
    entries: Mapping[str, Mapping[str, Checkpoint]],
    folder: Path,
    place_of: Callable[[Checkpoint], Path],
    write: Callable[[Checkpoint, Setup], _Report],
) -> dict[str, dict[str, _Report]]:
    """Evaluate the policies of several runs or seeds, and write a report on each.

    Args:
      entries: the policy of each seed by name, of each run by name.
      folder: the folder of the comparison.
      place_of: a function that returns the folder in which a policy's report will be.
      write: a function that evaluates a policy and writes its report.

    Returns:
      The report of each seed by name, of each run by name.

    Raises:
      UserError: an environment cannot be built, or a folder cannot be written.
    """
    # Build all environments first, so that an unsuitable policy is rejected before any writing.
    policies = [
        (name, seed, checkpoint, checkpoint.make_setup())
        for name, seeds in entries.items()
        for seed, checkpoint in seeds.items()
    ]
    for path in (folder, *(place_of(checkpoint) for _, _, checkpoint, _ in policies)):
        check_writable(path)
    by_run: dict[str, dict[str, _Report]] = {name: {} for name in entries}
    with stage("policies", len(policies)) as advance:
        for name, seed, checkpoint, setup in policies:
            by_run[name][seed] = write(checkpoint, setup)
            advance(1)
    return by_run


def _report_folder(checkpoint: Checkpoint, episodes: int) -> Path:
    name = name_with_count(checkpoint.path.name, episodes, REPORT_GOALS, "-episodes")
    return checkpoint.results_dir / _FOLDER / name


class _Reporter:
    """A `_Reporter` evaluates policies and writes their reports.

    It keeps the compiled evaluator, and the baselines' metrics, as long as they fit the policies.
    """

    def __init__(self, episodes: int) -> None:
        self._keys, self._versions = report_keys(episodes), runs.versions()
        self._built_for: tuple[object, ...] = ()

    def _build(self, checkpoint: Checkpoint, setup: Setup, env: AdaptedEnv) -> None:
        """Build the evaluator and evaluate the baselines, unless the present ones fit."""
        config = checkpoint.config
        # The parts of a configuration that the compiled episodes depend on.
        parts = (
            config.environment,
            config.environment_options,
            type(env.source),
            config.task.episode_length,
            config.physics,
            config.deterministic,
            config.ppo.network,
            config.ppo.normalize_observations,
        )
        if parts == self._built_for:
            return
        self._evaluator = ReturnEvaluator(env, setup.networks, setup.programs, baselines=True)
        self._baselines = {
            name: summarize_returns(
                self._evaluator.run(checkpoint.params, self._keys, name),
                has_success=env.has_success,
            )
            for name in return_baselines(env)
        }
        self._built_for = parts

    def write(self, checkpoint: Checkpoint, setup: Setup, folder: Path) -> ReturnReport:
        """Evaluate a policy and write its report.

        Args:
          checkpoint: the policy.
          setup: its environment, networks and programs.
          folder: the folder of the report.
        """
        env = setup.env
        assert isinstance(env, AdaptedEnv)
        self._build(checkpoint, setup, env)
        finished = jax.device_get(self._evaluator.run(checkpoint.params, self._keys))
        history = runs.read_history(checkpoint.run_dir / runs.METRICS)
        report = ReturnReport(
            folder=folder,
            run=runs.shortened(checkpoint.run_dir),
            checkpoint=checkpoint.path,
            env_steps=checkpoint.env_steps,
            config=checkpoint.config,
            dt=env.dt,
            policy=summarize_returns(finished, has_success=env.has_success),
            baselines=self._baselines,
            learning_curve=read_curve(ReturnPoint, history),
            episodes=finished,
            versions=self._versions,
            fallbacks=checkpoint.about.get("fallbacks", ()),
        )
        with stage("writing the report"):
            write_return_report(report)
        return report
