"""Judges a policy on fixed goals: `python -m jetbot_mjx.evaluate RUN [--min-success 0.95]`."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jetbot_mjx import cli
from jetbot_mjx.checkpoint import Checkpoint, Which, load_checkpoint
from jetbot_mjx.evaluation import (
    GOAL_SET_VERSION,
    Evaluator,
    Summary,
    mean_interval,
    report_keys,
    summarize,
)
from jetbot_mjx.run_folder import make_folder, seed_folders, versions, write_json

BELOW_TARGET = 1


class Report(NamedTuple):
    """A policy's figures and the baselines' on the same goals."""

    checkpoint: Path
    path: Path
    """The JSON file."""
    env_steps: int
    policy: Summary
    baselines: Mapping[str, Summary]


class SeedsReport(NamedTuple):
    """The policies of several seeds on the same goals."""

    path: Path
    """The JSON file; each seed has its own as well."""
    seeds: Mapping[str, Report]
    """By the name of the seed's folder."""
    mean: float
    """Of the success rates."""
    low: float
    """Lower end of the 95 % interval of that mean, over seeds."""
    high: float
    """Upper end of it."""


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
    return next(iter(_judge([load_checkpoint(run_or_checkpoint, which)], episodes)))


def run_seeds(run_dir: Path, *, episodes: int = 1024, which: Which = "best") -> SeedsReport:
    """Judges the policies of all seeds, and writes `evaluations/seeds.json` beside their reports.

    Args:
      run_dir: a run folder of several seeds.
      episodes: how many of the fixed goals, from the first on.
      which: the checkpoint of each seed.

    Returns:
      The report.

    Raises:
      UserError: a seed has no usable checkpoint.
    """
    folders = seed_folders(run_dir)
    checkpoints = [load_checkpoint(folder, which) for folder in folders]
    reports = dict(
        zip((folder.name for folder in folders), _judge(checkpoints, episodes), strict=True)
    )
    mean, low, high = mean_interval([one.policy.success_rate for one in reports.values()])
    make_folder(run_dir / "evaluations")
    path = run_dir / "evaluations" / "seeds.json"
    values = {
        "mean": mean,
        "low": low,
        "high": high,
        "seeds": {name: _as_json(report) for name, report in reports.items()},
    }
    write_json(path, values)
    return SeedsReport(path, reports, mean, low, high)


def _judge(checkpoints: Sequence[Checkpoint], episodes: int) -> Iterator[Report]:
    """Judges policies of one configuration, by one compiled program, and writes their reports."""
    env = checkpoints[0].make_env()
    evaluator = Evaluator(env, checkpoints[0].networks, baselines=True)
    keys = report_keys(episodes)
    baselines = {
        name: summarize(each, env.dt)
        for name, each in evaluator.run_baselines(checkpoints[0].params, keys).items()
    }
    for checkpoint in checkpoints:
        folder = checkpoint.run_dir / "evaluations" / checkpoint.path.name
        make_folder(folder)
        policy = summarize(evaluator.run(checkpoint.params, keys), env.dt)
        report = Report(
            checkpoint.path, folder / "report.json", checkpoint.env_steps, policy, baselines
        )
        write_json(report.path, _as_json(report))
        yield report


def _as_json(report: Report) -> dict[str, Any]:
    return {
        "goal_set_version": GOAL_SET_VERSION,
        "checkpoint": report.checkpoint.name,
        "env_steps": report.env_steps,
        "policy": report.policy._asdict(),
        "baselines": {name: summary._asdict() for name, summary in report.baselines.items()},
        "versions": versions(),
    }


def table(policies: Mapping[str, Report]) -> str:
    """Policies by name, and the baselines below them, as a table for the terminal."""
    head = (
        f"{'':10}  {'success':>8}  {'95 % interval':>16}  {'to goal':>8}  {'p95':>7}"
        f"  {'path':>5}  {'return':>7}"
    )
    rows = [_row(name, report.policy) for name, report in policies.items()]
    baselines = next(iter(policies.values())).baselines
    rows += [_row(name, summary) for name, summary in baselines.items()]
    return "\n".join([head, *rows])


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
    cli.use_compilation_cache()
    if seed_folders(Path(options.run)):
        return _main_seeds(options)
    report = run(options.run, episodes=options.episodes, which=options.checkpoint)
    print(
        f"{report.policy.episodes} fixed goals (set {GOAL_SET_VERSION}), policy after"
        f" {report.env_steps:,} steps\n{table({'policy': report})}\nreport: {report.path}"
    )
    if report.policy.nonfinite_worlds:
        print(f"{report.policy.nonfinite_worlds} episodes ended in a world that blew up")
    return _verdict(report.policy.success_rate, options.min_success)


def _main_seeds(options: argparse.Namespace) -> int:
    report = run_seeds(Path(options.run), episodes=options.episodes, which=options.checkpoint)
    print(
        f"{options.episodes} fixed goals (set {GOAL_SET_VERSION}), {len(report.seeds)} seeds\n"
        f"{table(report.seeds)}\n"
        f"mean over seeds: {report.mean:.2%} (95 % interval {report.low:.2%} .. {report.high:.2%})"
        f"\nreport: {report.path}"
    )
    return _verdict(report.mean, options.min_success)


def _verdict(success_rate: float, wanted: float | None) -> int:
    if wanted is not None and success_rate < wanted:
        print(f"success {success_rate:.2%} is below the {wanted:.2%} asked for")
        return BELOW_TARGET
    return 0


if __name__ == "__main__":
    cli.run_command(main)
