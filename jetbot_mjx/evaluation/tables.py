"""Format the results of evaluations as tables and lines for the terminal."""

from collections.abc import Mapping

from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.comparison import Comparison, few_seeds_line, told_step_cost, won_on
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION
from jetbot_mjx.evaluation.report import Report
from jetbot_mjx.evaluation.result_names import fuller_report, kept_line
from jetbot_mjx.evaluation.return_report import ReturnComparison, ReturnReport
from jetbot_mjx.evaluation.return_tables import (
    summarize_return_comparison,
    summarize_return_report,
)
from jetbot_mjx.evaluation.robustness import ROBUST_SUCCESS_RATE, robust_range
from jetbot_mjx.terminal import text_table


def summarize_report(report: Report | ReturnReport) -> str:
    """Return the results of one policy."""
    if isinstance(report, ReturnReport):
        return summarize_return_report(report)
    text = (
        f"{_count(report.policy.episodes, 'fixed goal')} (set {GOAL_SET_VERSION}), policy after"
        f" {report.env_steps:,} steps\n{policies_table({'policy': report})}\n"
        f"{_step_cost_line(report)}{_simulators_line(report)}"
        f"{best_known_lines(report)}{lower_bound_line(report)}{robustness_table(report)}"
        f"report: {report.folder / 'report.html'}"
    )
    if fuller := fuller_report(report.folder, report.checkpoint.name):
        text += f" (the one in {fuller} stays as it is)"
    if report.policy.nonfinite_envs:
        text += f"\n{_count(report.policy.nonfinite_envs, 'episode')} ended in a non-finite state"
    return text


def _step_cost_line(report: Report) -> str:
    cost = report.config.task.step_cost
    return f"each step costs {cost:g} m of the return\n" if cost else ""


def _simulators_line(report: Report) -> str:
    """Return why a policy's success in C MuJoCo differs, if the intervals do not overlap."""
    if report.mujoco is None:
        return ""
    here, there = report.policy, report.mujoco.policy
    if here.success_low <= there.success_high and there.success_low <= here.success_high:
        return ""
    return (
        "the success depends on the simulator's numerics: C MuJoCo computes with another"
        " integrator, friction cone,\n  softness of contacts and time step than the training"
        " (docs/robustness.md)\n"
    )


def summarize_comparison(comparison: Comparison | ReturnComparison) -> str:
    """Return the results of all policies of a comparison, and the differences between its runs."""
    if isinstance(comparison, ReturnComparison):
        return summarize_return_comparison(comparison)
    runs = comparison.runs
    policies = {
        seed if len(runs) == 1 else f"{run.name} {seed}" if len(run.seeds) > 1 else run.name: report
        for run in runs
        for seed, report in run.seeds.items()
    }
    text = (
        f"{_count(comparison.episodes, 'fixed goal')} (set {GOAL_SET_VERSION}),"
        f" {len(policies)} policies\n{policies_table(policies)}\n"
    )
    if cost := told_step_cost(comparison):
        text += f"{cost}\n"
    caveat = few_seeds_line(run.success_rate for run in runs)
    text += f"\n{runs_table(comparison)}\n{caveat}"
    if comparison.pairs:
        text += f"\n{pairs_table(comparison)}\n"
    return f"{text}report: {comparison.folder / 'comparison.html'}{kept_line(comparison.folder)}"


def below_target(
    result: Report | ReturnReport | Comparison | ReturnComparison, target: float
) -> list[str]:
    """Return a line for every run whose success rate is below the target.

    Args:
      result: The report of one policy, or a comparison.
      target: The smallest accepted success rate, between 0 and 1.

    Returns:
      The lines. They name the run where there are several.

    Raises:
      UserError: there is a target, and the environment has no metric `success`.
    """
    rates: Mapping[str, float | None]
    if isinstance(result, Report | ReturnReport):
        rates = {"": result.policy.success_rate}
    else:
        rates = {
            run.name: run.success_rate and (run.success_rate.mean.value or 0.0)
            for run in result.runs
        }
    if target > 0 and None in rates.values():
        raise UserError(
            f"--min-success {target:g}: the environment has no metric 'success': leave it out"
        )
    prefix = "{}: " if len(rates) > 1 else ""
    return [
        f"{prefix.format(name)}success {rate:.2%} is below the {target:.2%} asked for"
        for name, rate in rates.items()
        if rate is not None and rate < target
    ]


def policies_table(policies: Mapping[str, Report]) -> str:
    """Return a table of policies by name, with the baselines below them.

    Where a step does not cost the same for all policies, the table has no returns, which then say
    nothing about which policy is better.
    """
    first = next(iter(policies.values()))
    rows = [("", "success", "95 % interval", "to goal", "p95", "path", "return")]
    for name, report in policies.items():
        rows += _rows(name, report.policy, report.randomized)
        if report.mujoco:
            rows += _rows(f"{name} in C MuJoCo", report.mujoco.policy, report.mujoco.randomized)
            for appearance, summary in (report.mujoco.rendered or {}).items():
                rows += _rows(f"{name} in C MuJoCo, {appearance} pictures", summary)
    for name, summary in first.baselines.items():
        rows += _rows(name, summary)
    if best := first.best_known:
        times = f"{best.time_to_goal_median:.2f} s", f"{best.time_to_goal_p95:.2f} s"
        rows.append(("best known", "-", "-", *times, "-", "-"))
    if len({report.config.task.step_cost for report in policies.values()}) > 1:
        rows = [row[:-1] for row in rows]
    return text_table(rows)


def _rows(name: str, *summaries: Summary | None) -> list[tuple[str, ...]]:
    """Return a row of metrics, and a second one if there are metrics on randomised robots."""
    return [
        (
            title,
            f"{one.success_rate:.2%}",
            f"{one.success_low:.2%} .. {one.success_high:.2%}",
            _value(one.time_to_goal_median, "{:.2f} s"),
            _value(one.time_to_goal_p95, "{:.2f} s"),
            _value(one.path_efficiency, "{:.0%}"),
            f"{one.episode_return:+.3f}",
        )
        for title, one in zip((name, f"{name}, randomised robots"), summaries, strict=False)
        if one
    ]


def best_known_lines(report: Report) -> str:
    """Return lines with a policy's gap to the best-known times, or why there is none."""
    best = report.best_known
    if best is None:
        return f"best known: not available, {report.best_known_missing}\n"
    if best.total.gap is None:
        return "best known: no comparison, because the policy reached no goal\n"
    directions = ", ".join(
        f"{180 - (180 - (one.bearing_low + one.bearing_high) / 2) % 360:.0f}° {one.gap:+.1%}"
        for one in best.by_direction
        if one.gap is not None
    )
    goals = "one goal" if best.total.reached == 1 else f"mean of {best.total.reached:,} goals"
    return (
        f"{abs(best.total.gap):.2%} {'slower' if best.total.gap >= 0 else 'faster'} than best known"
        f" ({goals}: {best.total.policy_mean:.3f} s, best known"
        f" {best.total.best_mean:.3f} s)\n  by the goal's bearing: {directions}\n"
    )


def lower_bound_line(report: Report) -> str:
    """Return a line with a policy's gap to the bound below all times, or why there is none."""
    bound = report.lower_bound
    if bound is None:
        return f"what physics allows: not known, {report.lower_bound_missing}\n"
    if bound.total.gap is None:
        return ""
    return (
        f"within {bound.total.gap:.2%} of what physics allows: {bound.total.policy_mean:.3f} s on"
        f" average, and no controller reaches the same goals in less than"
        f" {bound.total.best_mean:.3f} s\n"
    )


def robustness_table(report: Report) -> str:
    """Return a line for each parameter: robust range, and worst success; empty if not evaluated."""
    lines, spans = [], [robust_range(result) for result in report.robustness]
    for result, span in zip(report.robustness, spans, strict=True):
        unit = result.sweep.unit
        text = f"{span[0]:g} to {span[1]:g} {unit}" if span else "-"
        worst = min(
            zip(result.policy, result.sweep.values, strict=True), key=lambda x: x[0].success_rate
        )
        lines.append(
            f"  {result.sweep.label:26}  {text:24}"
            f"  {worst[0].success_rate:6.1%} at {worst[1]:g} {unit}".rstrip()
            + "\n"
        )
    if not lines:
        return ""
    rate = f"{ROBUST_SUCCESS_RATE:.0%}"
    said = (
        f"success stays at {rate} or above (evaluated on fewer goals) over the range, and is least"
    )
    if not any(spans):
        said = (
            f"success is below {rate} already at the preset (evaluated on fewer goals), and least"
        )
    return f"{said}\n{''.join(lines)}"


def runs_table(comparison: Comparison) -> str:
    """Return a table of the results of each run over its seeds."""
    rows = [
        ("", "success, mean", "interquartile mean", "median time to goal", "95 % intervals over")
    ]
    rows += [
        (
            run.name,
            run.success_rate.mean.told("{:.2%}"),
            run.success_rate.iqm.told("{:.2%}"),
            run.time_to_goal.mean.told("{:.2f} s"),
            f"{run.success_rate.count:,} {run.success_rate.over}",
        )
        for run in comparison.runs
    ]
    return text_table(rows)


def pairs_table(comparison: Comparison) -> str:
    """Return a table that compares every two runs with each other."""
    lines, runs = [], {run.name: run for run in comparison.runs}
    for pair in comparison.pairs:
        goals = won_on("goals", pair.seeds, (runs[pair.a], runs[pair.b]))
        lines.append(f"{pair.a} against {pair.b}")
        quantities = (
            ("success", pair.success_rate, "{:+.2%}"),
            ("time", pair.time_to_goal, "{:+.3f} s"),
        )
        lines += [f"  {name:8}  {result.told(form, goals)}" for name, result, form in quantities]
    return "\n".join(lines)


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def _value(value: float | None, form: str) -> str:
    return form.format(value) if value is not None else "-"
