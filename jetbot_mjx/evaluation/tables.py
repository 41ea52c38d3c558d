"""Format the results of policies and runs as tables for the terminal."""

from collections.abc import Mapping

from jetbot_mjx.evaluation.bootstrap import Estimate
from jetbot_mjx.evaluation.comparison import Comparison
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.evaluation.report import Report
from jetbot_mjx.evaluation.robustness import ROBUST_SUCCESS_RATE, robust_range


def policies_table(policies: Mapping[str, Report]) -> str:
    """Return a table of policies by name, with the baselines below them."""
    baselines = next(iter(policies.values())).baselines
    rows: list[tuple[str, Summary]] = []
    for name, report in policies.items():
        rows.append((name, report.policy))
        if report.randomized:
            rows.append((f"{name}, randomised robots", report.randomized))
        if report.mujoco:
            rows.append((f"{name} in C MuJoCo", report.mujoco.policy))
            if report.mujoco.randomized:
                randomized = report.mujoco.randomized
                rows.append((f"{name} in C MuJoCo, randomised robots", randomized))
    rows += baselines.items()
    width = max(10, *(len(name) for name, _ in rows))
    head = (
        f"{'':{width}}  {'success':>8}  {'95 % interval':>16}  {'to goal':>8}  {'p95':>7}"
        f"  {'path':>5}  {'return':>7}"
    )
    lines = [head, *(_row(name, row, width) for name, row in rows)]
    if best := next(iter(policies.values())).best_known:
        lines.append(
            f"{'best known':{width}}  {'-':>8}  {'-':>16}  {best.time_to_goal_median:6.2f} s"
            f"  {best.time_to_goal_p95:5.2f} s  {'-':>5}  {'-':>7}"
        )
    return "\n".join(lines)


def _row(name: str, summary: Summary, width: int) -> str:
    interval = f"{summary.success_low:.2%} .. {summary.success_high:.2%}"
    return (
        f"{name:{width}}  {summary.success_rate:8.2%}  {interval:>16}"
        f"  {_value(summary.time_to_goal_median, '{:.2f} s'):>8}"
        f"  {_value(summary.time_to_goal_p95, '{:.2f} s'):>7}"
        f"  {_value(summary.path_efficiency, '{:.0%}'):>5}  {summary.episode_return:+7.3f}"
    )


def best_known_lines(report: Report) -> str:
    """Return lines with a policy's gap to the best-known times, or why there is none."""
    best = report.best_known
    if best is None:
        return f"best known: not available, {report.best_known_missing}\n"
    if best.total.gap is None:
        return "best known: the policy reached no goal to be compared on\n"
    directions = ", ".join(
        f"{180 - (180 - (one.bearing_low + one.bearing_high) / 2) % 360:.0f}° {one.gap:+.1%}"
        for one in best.by_direction
        if one.gap is not None
    )
    return (
        f"time to goal above the best known: {best.total.gap:+.2%} in the mean of"
        f" {best.total.reached:,} goals reached ({best.total.policy_mean:.3f} s,"
        f" {best.total.best_mean:.3f} s)\n  by the goal's bearing: {directions}\n"
    )


def robustness_table(report: Report) -> str:
    """Return one line for each parameter with its robust range; empty if not evaluated."""
    lines = []
    for result in report.robustness:
        span = robust_range(result)
        text = (
            f"{span[0]:g} to {span[1]:g} {result.sweep.unit}" if span else "not even at the preset"
        )
        lines.append(f"  {result.sweep.label:26}  {text}\n")
    if not lines:
        return ""
    rate = f"{ROBUST_SUCCESS_RATE:.0%}"
    return f"success stays at {rate} or above (evaluated on fewer goals) over\n{''.join(lines)}"


def runs_table(comparison: Comparison) -> str:
    """Return a table of the results of each run over its seeds."""
    width = max(10, *(len(run.name) for run in comparison.runs))
    lines = [
        f"{'':{width}}  {'success, mean':>28}  {'interquartile mean':>28}"
        f"  {'time to goal, mean':>24}  95 % intervals over"
    ]
    for run in comparison.runs:
        lines.append(
            f"{run.name:{width}}  {_estimate(run.success_rate.mean, '{:.2%}'):>28}"
            f"  {_estimate(run.success_rate.iqm, '{:.2%}'):>28}"
            f"  {_estimate(run.time_to_goal.mean, '{:.2f} s'):>24}"
            f"  {run.success_rate.count:,} {run.success_rate.over}"
        )
    return "\n".join(lines)


def pairs_table(comparison: Comparison) -> str:
    """Return a table that compares every two runs with each other."""
    lines = []
    for pair in comparison.pairs:
        lines.append(f"{pair.a} against {pair.b}")
        quantities = (
            ("success", pair.success_rate, "{:+.2%}"),
            ("time", pair.time_to_goal, "{:+.3f} s"),
        )
        for name, result, form in quantities:
            lines.append(
                f"  {name:8}  difference {_estimate(result.difference, form)},"
                f" improvement {_estimate(result.improvement, '{:.0%}')},"
                f" goals {result.wins} : {result.losses} (p {result.p:.2g})"
            )
    return "\n".join(lines)


def _value(value: float | None, form: str) -> str:
    return form.format(value) if value is not None else "-"


def _estimate(estimate: Estimate, form: str) -> str:
    text = _value(estimate.value, form)
    if estimate.low is None:
        return text
    return f"{text} ({_value(estimate.low, form)} .. {_value(estimate.high, form)})"
