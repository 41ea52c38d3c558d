"""Judges a policy on fixed goals: `python -m jetbot_mjx.evaluate RUN [--min-success 0.95]`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jetbot_mjx import cli
from jetbot_mjx.checkpoint import Which, load_checkpoint
from jetbot_mjx.evaluation import (
    GOAL_SET_VERSION,
    Evaluator,
    Summary,
    report_keys,
    summarize,
)
from jetbot_mjx.run_folder import make_folder, versions, write_json

BELOW_TARGET = 1


class Report(NamedTuple):
    """A policy's figures and the baselines' on the same goals."""

    checkpoint: Path
    path: Path
    """The JSON file."""
    env_steps: int
    policy: Summary
    baselines: Mapping[str, Summary]


def run(run_or_checkpoint: str | Path, *, episodes: int = 1024, which: Which = "best") -> Report:
    """Judges a policy and writes `evaluations/<env_steps>/report.json` into its run folder.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      episodes: how many of the fixed goals, from the first on.
      which: the checkpoint of a run folder.

    Returns:
      The report.

    Raises:
      UserError: there is no usable checkpoint.
    """
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    env = checkpoint.make_env()
    folder = checkpoint.run_dir / "evaluations" / checkpoint.path.name
    make_folder(folder)
    evaluator = Evaluator(env, checkpoint.networks, baselines=True)
    keys = report_keys(episodes)
    policy = summarize(evaluator.run(checkpoint.params, keys), env.dt)
    baselines = {
        name: summarize(episodes, env.dt)
        for name, episodes in evaluator.run_baselines(checkpoint.params, keys).items()
    }
    report = Report(
        checkpoint.path, folder / "report.json", checkpoint.env_steps, policy, baselines
    )
    write_json(report.path, _as_json(report))
    return report


def _as_json(report: Report) -> dict[str, Any]:
    return {
        "goal_set_version": GOAL_SET_VERSION,
        "checkpoint": report.checkpoint.name,
        "env_steps": report.env_steps,
        "policy": report.policy._asdict(),
        "baselines": {name: summary._asdict() for name, summary in report.baselines.items()},
        "versions": versions(),
    }


def table(report: Report) -> str:
    """The report as a table for the terminal."""
    head = (
        f"{'':10}  {'success':>8}  {'95 % interval':>16}  {'to goal':>8}  {'p95':>7}"
        f"  {'path':>5}  {'return':>7}"
    )
    rows = [_row(name, summary) for name, summary in report.baselines.items()]
    return "\n".join([head, _row("policy", report.policy), *rows])


def _row(name: str, summary: Summary) -> str:
    def shown(value: float | None, form: str) -> str:
        return form.format(value) if value is not None else "-"

    interval = f"{summary.success_low:.2%} .. {summary.success_high:.2%}"
    return (
        f"{name:10}  {summary.success_rate:8.2%}  {interval:>16}"
        f"  {shown(summary.time_to_goal_median, '{:.2f} s'):>8}"
        f"  {shown(summary.time_to_goal_p95, '{:.2f} s'):>7}"
        f"  {shown(summary.path_efficiency, '{:.0%}'):>5}  {summary.episode_return:+7.3f}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line and judges.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 1 where the success rate is below `--min-success`.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.evaluate", description=__doc__)
    cli.add_checkpoint_arguments(parser)
    parser.add_argument("--episodes", type=cli.positive_int, default=1024)
    parser.add_argument(
        "--min-success", type=cli.fraction, help="exit with 1 below this success rate"
    )
    options = parser.parse_args(arguments)
    cli.require_device()
    report = run(options.run, episodes=options.episodes, which=options.checkpoint)
    print(
        f"{report.policy.episodes} fixed goals (set {GOAL_SET_VERSION}), policy after"
        f" {report.env_steps:,} steps\n{table(report)}\nreport: {report.path}"
    )
    if report.policy.nonfinite_worlds:
        print(f"{report.policy.nonfinite_worlds} episodes ended in a world that blew up")
    wanted = options.min_success
    if wanted is not None and report.policy.success_rate < wanted:
        print(f"success {report.policy.success_rate:.2%} is below the {wanted:.2%} asked for")
        return BELOW_TARGET
    return 0


if __name__ == "__main__":
    cli.run_command(main)
