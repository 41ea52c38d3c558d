"""Return the results of evaluations as lines for the terminal."""

from collections.abc import Mapping

from jetbot_mjx.evaluation.comparison import Comparison
from jetbot_mjx.evaluation.evaluator import GOAL_SET_VERSION
from jetbot_mjx.evaluation.report import Report
from jetbot_mjx.evaluation.result_names import fuller_report
from jetbot_mjx.evaluation.tables import (
    best_known_lines,
    pairs_table,
    policies_table,
    robustness_table,
    runs_table,
)


def summarize_report(report: Report) -> str:
    """Return the results of one policy."""
    text = (
        f"{report.policy.episodes} fixed goals (set {GOAL_SET_VERSION}), policy after"
        f" {report.env_steps:,} steps\n{policies_table({'policy': report})}\n"
        f"{best_known_lines(report)}{robustness_table(report)}"
        f"report: {report.folder / 'report.html'}"
    )
    if fuller := fuller_report(report.folder, report.checkpoint.name):
        text += f" (the one in {fuller} stays as it is)"
    if report.policy.nonfinite_envs:
        text += f"\n{report.policy.nonfinite_envs} episodes ended in a non-finite state"
    return text


def summarize_comparison(comparison: Comparison) -> str:
    """Return the results of all policies of a comparison, and the differences between its runs."""
    runs = comparison.runs
    policies = {
        seed if len(runs) == 1 else f"{run.name} {seed}" if len(run.seeds) > 1 else run.name: report
        for run in runs
        for seed, report in run.seeds.items()
    }
    text = (
        f"{comparison.episodes} fixed goals (set {GOAL_SET_VERSION}), {len(policies)} policies\n"
        f"{policies_table(policies)}\n\n{runs_table(comparison)}"
    )
    if comparison.pairs:
        text += f"\n\n{pairs_table(comparison)}"
    return f"{text}\nreport: {comparison.folder / 'comparison.html'}"


def below_target(result: Report | Comparison, target: float) -> list[str]:
    """Return a line for every run whose success rate is below the target.

    Args:
      result: The report of one policy, or a comparison.
      target: The smallest accepted success rate, between 0 and 1.

    Returns:
      The lines. They name the run where there are several.
    """
    rates: Mapping[str, float]
    if isinstance(result, Report):
        rates = {"": result.policy.success_rate}
    else:
        rates = {run.name: run.success_rate.mean.value or 0.0 for run in result.runs}
    prefix = "{}: " if len(rates) > 1 else ""
    return [
        f"{prefix.format(name)}success {rate:.2%} is below the {target:.2%} asked for"
        for name, rate in rates.items()
        if rate < target
    ]
