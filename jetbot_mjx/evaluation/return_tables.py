"""Format the returns of policies as tables and lines for the terminal."""

from collections.abc import Mapping

from jetbot_mjx.evaluation.comparison import few_seeds_line, won_on
from jetbot_mjx.evaluation.result_names import kept_line
from jetbot_mjx.evaluation.return_report import ReturnComparison, ReturnReport
from jetbot_mjx.evaluation.returns import ReturnSummary
from jetbot_mjx.terminal import text_table


def summarize_return_report(report: ReturnReport) -> str:
    """Return the results of one policy."""
    policy = report.policy
    text = (
        f"{policy.episodes:,} fixed starts, policy after {report.env_steps:,} steps\n"
        f"{_policies_table({'policy': policy, **report.baselines})}\n"
        f"report: {report.folder / 'report.html'}"
    )
    if policy.nonfinite_envs:
        text += f"\n{policy.nonfinite_envs:,} episodes ended in a non-finite state"
    return text


def summarize_return_comparison(comparison: ReturnComparison) -> str:
    """Return the results of all policies of a comparison, and the differences between its runs."""
    runs = comparison.runs
    policies = {
        f"{run.name} {seed}" if len(run.seeds) > 1 else run.name: report.policy
        for run in runs
        for seed, report in run.seeds.items()
    }
    rows = [("", "return, mean", "interquartile mean", "success, mean", "95 % intervals over")]
    for run in runs:
        found = run.episode_return
        success = run.success_rate.mean.told("{:.2%}") if run.success_rate else "-"
        over = f"{found.count:,} {found.over}"
        both = found.mean.told("{:z.2f}"), found.iqm.told("{:z.2f}")
        rows.append((run.name, *both, success, over))
    lines = [
        f"{comparison.episodes:,} fixed starts, {len(policies)} policies",
        _policies_table({**policies, **comparison.baselines}),
        f"\n{text_table(rows)}\n{few_seeds_line(run.episode_return for run in runs)}",
    ]
    by_name = {run.name: run for run in runs}
    for pair in comparison.pairs:
        starts = won_on("starts", pair.seeds, (by_name[pair.a], by_name[pair.b]))
        lines.append(f"{pair.a} against {pair.b}: {pair.episode_return.told('{:+z.2f}', starts)}")
    lines += comparison.other_code
    page = comparison.folder / "comparison.html"
    return "\n".join([*lines, f"report: {page}{kept_line(comparison.folder)}"])


def _policies_table(policies: Mapping[str, ReturnSummary]) -> str:
    rows = [("", "return", "95 % interval", "lowest", "length", "success")]
    rows += [
        (
            name,
            f"{one.episode_return:z.2f}",
            f"{one.return_low:z.2f} .. {one.return_high:z.2f}",
            f"{one.return_min:z.2f}",
            f"{one.episode_length:.1f}",
            "-" if one.success_rate is None else f"{one.success_rate:.2%}",
        )
        for name, one in policies.items()
    ]
    return text_table(rows)
