"""Judges policies on fixed goals: `python -m jetbot_mjx.evaluate RUN [RUN ...]`.

One policy gets a report. Several seeds, or several runs, are compared as well.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.config import Config, RandomizationConfig, load_config
from jetbot_mjx.envs.domain_randomization import DomainRandomizationWrapper
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.mujoco_simulator import OTHER_NUMERICS, Numerics
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.comparison import Comparison, check_comparable, compare
from jetbot_mjx.evaluation.evaluator import (
    GOAL_SET_VERSION,
    MOST_GOALS,
    REPORT_GOALS,
    Evaluator,
    report_keys,
    summarize,
)
from jetbot_mjx.evaluation.html_report import write_comparison, write_report
from jetbot_mjx.evaluation.report import (
    CurvePoint,
    Report,
    by_goal,
    compare_with_best_known,
    find_failures,
    learning_curve,
)
from jetbot_mjx.evaluation.robustness import (
    SWEEP_GOALS,
    MujocoEvaluator,
    MujocoResult,
    SweepResult,
    sweep,
)
from jetbot_mjx.evaluation.tables import (
    best_known_lines,
    pairs_table,
    policies_table,
    robustness_table,
    runs_table,
)
from jetbot_mjx.runs.checkpoint import Checkpoint, Which, load_checkpoint
from jetbot_mjx.runs.metrics import read_history
from jetbot_mjx.runs.run_dir import seed_folders, versions

BELOW_TARGET = 1

Simulator = Literal["mujoco"]
"""A simulator other than the one that policies are trained in."""


def run(
    run_or_checkpoint: str | Path,
    *,
    episodes: int = REPORT_GOALS,
    which: Which = "best",
    output: str | Path | None = None,
    robustness: bool = False,
    ranges: str | Path | None = None,
    simulator: Simulator | None = None,
) -> Report:
    """Evaluate one policy and write its report.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      episodes: how many of the fixed goals, from the first on.
      which: the checkpoint of a run folder.
      output: the folder to write; None: `evaluations/<env_steps>/` of the run folder.
      robustness: whether to evaluate it also on robots that differ from the preset, and in C
        MuJoCo.
      ranges: a configuration file by whose `randomization` a robot is drawn for each goal, beside
        the preset's; None: the run's own, if it has any.
      simulator: in which to evaluate it beside the one that it was trained in.

    Returns:
      The report, which knows its folder.

    Raises:
      UserError: there is no usable checkpoint, or the folder cannot be written.
    """
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    folder = _report_folder(checkpoint) if output is None else Path(output)
    drawn = _Ranges.read(ranges)
    reports = _judge(
        [(checkpoint, folder)],
        episodes,
        robustness=robustness,
        elsewhere=robustness or simulator is not None,
        drawn=drawn,
    )
    return next(reports)


def evaluate_in_mujoco(
    run_or_checkpoint: str | Path,
    *,
    episodes: int = REPORT_GOALS,
    which: Which = "best",
    ranges: str | Path | None = None,
    numerics: Numerics = OTHER_NUMERICS,
) -> MujocoResult:
    """Evaluate one policy in C MuJoCo, and write nothing.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      episodes: how many of the fixed goals, from the first on.
      which: the checkpoint of a run folder.
      ranges: as for `run`.
      numerics: how C MuJoCo computes.

    Returns:
      The metrics.

    Raises:
      UserError: there is no usable checkpoint, or JAX was told to do without a CPU.
    """
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    drawn = _Ranges.read(ranges)
    evaluator = MujocoEvaluator(
        checkpoint.make_env(),
        checkpoint.networks,
        drawn.ranges if drawn else checkpoint.config.randomization,
        numerics,
    )
    return evaluator.run(checkpoint.params, report_keys(episodes))


def run_comparison(
    runs: Sequence[str | Path],
    *,
    episodes: int = REPORT_GOALS,
    which: Which = "best",
    output: str | Path | None = None,
    robustness: bool = False,
    ranges: str | Path | None = None,
    simulator: Simulator | None = None,
) -> Comparison:
    """Evaluate the policies of several runs or seeds, write a report on each, and compare them.

    Args:
      runs: run folders, of one seed or several, or checkpoint folders.
      episodes: how many of the fixed goals, from the first on.
      which: the checkpoint of a run folder, of each seed.
      output: the folder for the comparison; None: `evaluations/comparison/` of the first run.
      robustness: whether each policy is also evaluated on other robots and in C MuJoCo.
      ranges: as for `run`.
      simulator: as for `run`.

    Returns:
      The comparison, which knows its folder; each report knows its own.

    Raises:
      UserError: a checkpoint cannot be used or is named twice, the runs have different tasks, or a
        folder cannot be written.
    """
    # Load all policies and check that they can be compared.
    entrants = _load([Path(path) for path in runs], which)
    check_comparable({name: entrant.config for name, entrant in entrants.items()})
    # Evaluate each policy and write its report.
    checkpoints = [one for entrant in entrants.values() for one in entrant.seeds.values()]
    reports = _judge(
        [(one, _report_folder(one)) for one in checkpoints],
        episodes,
        robustness=robustness,
        elsewhere=robustness or simulator is not None,
        drawn=_Ranges.read(ranges),
    )
    judged = {
        name: {seed: _without_paths(next(reports)) for seed in entrant.seeds}
        for name, entrant in entrants.items()
    }
    # Compare the reports and write the comparison.
    home = next(iter(entrants.values())).folder
    folder = home / "evaluations" / "comparison" if output is None else Path(output)
    comparison = compare(folder.absolute(), judged)
    write_comparison(comparison)
    return comparison


class _Ranges(NamedTuple):
    """A `_Ranges` holds the ranges of `--ranges`, from which robots are drawn for every run."""

    file: Path
    ranges: RandomizationConfig

    @classmethod
    def read(cls, path: str | Path | None) -> "_Ranges | None":
        if path is None:
            return None
        ranges = load_config(path).randomization
        if not ranges.drawn:
            raise UserError(
                f"--ranges {path}: it draws nothing; give a configuration with ranges below"
                " `randomization`, such as configs/real_jetbot.yaml"
            )
        return cls(Path(path), ranges)


class RunEntry(NamedTuple):
    """A `RunEntry` is a run that takes part in a comparison."""

    folder: Path
    seeds: Mapping[str, Checkpoint]

    @property
    def config(self) -> Config:
        """Return the configuration of the first seed."""
        return next(iter(self.seeds.values())).config


def _load(paths: Sequence[Path], which: Which) -> dict[str, RunEntry]:
    """Load the runs and return them by a unique name."""
    entrants: list[RunEntry] = []
    owners: dict[Path, Path] = {}
    for path in paths:
        folders = seed_folders(path)
        seeds = {one.name: load_checkpoint(one, which) for one in folders or [path]}
        for checkpoint in seeds.values():
            place = checkpoint.path.resolve()
            if place in owners:
                raise UserError(
                    f"{path} and {owners[place]} are the same policy, {_shown(checkpoint.path)}:"
                    " name each once"
                )
            owners[place] = path
        first = next(iter(seeds.values()))
        entrants.append(RunEntry(first.run_dir.parent if folders else first.run_dir, seeds))
    return dict(zip(_names(entrants), entrants, strict=True))


def _names(entrants: Sequence[RunEntry]) -> list[str]:
    """Return the shortest unique end of each folder's path, with the steps if needed."""
    folders = [entrant.folder for entrant in entrants]
    different = set(folders)
    length = 1
    while len({folder.parts[-length:] for folder in different}) < len(different):
        length += 1
    names = []
    for entrant in entrants:
        name = "/".join(entrant.folder.parts[-length:])
        if folders.count(entrant.folder) > 1:
            name += f" @ {next(iter(entrant.seeds.values())).env_steps:,}"
        names.append(name)
    return names


def _report_folder(checkpoint: Checkpoint) -> Path:
    return checkpoint.run_dir / "evaluations" / checkpoint.path.name


def _without_paths(report: Report) -> Report:
    """Return a report without trajectories, which are large and already plotted."""
    return report._replace(episodes=report.episodes._replace(qpos=None))


def _judge(
    checkpoints: Sequence[tuple[Checkpoint, Path]],
    episodes: int,
    *,
    robustness: bool,
    elsewhere: bool,
    drawn: _Ranges | None,
) -> Iterator[Report]:
    """Evaluate policies and write their reports, reusing compiled programs where they fit."""
    keys, about = report_keys(episodes), versions()
    # Build all environments first, so that an unsuitable policy is rejected before any writing.
    envs = [checkpoint.make_env() for checkpoint, _ in checkpoints]
    evaluator, varied, mujoco, baselines, fits = None, None, None, {}, None
    for (checkpoint, folder), env in zip(checkpoints, envs, strict=True):
        ranges = drawn.ranges if drawn else checkpoint.config.randomization
        # Build new evaluators only if the compiled programs do not fit this policy.
        if evaluator is None or (_program(checkpoint.config), ranges) != fits:
            evaluator = Evaluator(env, checkpoint.networks, baselines=True, record=True)
            if ranges.drawn:
                varied = Evaluator(
                    DomainRandomizationWrapper(env, ranges=ranges), checkpoint.networks
                )
            if elsewhere:
                mujoco = MujocoEvaluator(env, checkpoint.networks, ranges)
            fits = _program(checkpoint.config), ranges
            beside = evaluator.run_baselines(checkpoint.params, keys)
            baselines = {name: summarize(each, env.dt) for name, each in beside.items()}
        # Evaluate the policy and write its report.
        driven = jax.device_get(evaluator.run(checkpoint.params, keys))
        run_dir = _shown(checkpoint.run_dir)
        best_known, missing = compare_with_best_known(checkpoint.config, driven)
        report = Report(
            folder=folder,
            run=run_dir,
            checkpoint=checkpoint.path,
            env_steps=checkpoint.env_steps,
            config=checkpoint.config,
            policy=summarize(driven, env.dt),
            baselines=baselines,
            goal_bins=by_goal(driven, env.dt),
            failures=find_failures(driven, run_dir, checkpoint.env_steps),
            learning_curve=_learning_curve(checkpoint.run_dir),
            episodes=driven,
            versions=about,
            robustness=_sweep(checkpoint, env, min(episodes, SWEEP_GOALS)) if robustness else (),
            randomized=(
                summarize(varied.run(checkpoint.params, keys), env.dt)
                if varied and ranges.drawn
                else None
            ),
            ranges=ranges if ranges.drawn else None,
            ranges_file=drawn.file if drawn else None,
            mujoco=mujoco.run(checkpoint.params, keys) if mujoco else None,
            best_known=best_known,
            best_known_missing=missing,
        )
        write_report(report)
        yield report


def _sweep(checkpoint: Checkpoint, env: JetBotEnv, goals: int) -> tuple[SweepResult, ...]:
    return sweep(env, checkpoint.networks, checkpoint.params, report_keys(goals))


def _program(config: Config) -> tuple[Any, ...]:
    """Return the parts of a configuration that the compiled episodes depend on."""
    ppo = config.ppo
    return (
        config.task,
        config.robot,
        config.physics,
        config.deterministic,
        ppo.network,
        ppo.normalize_observations,
    )


def _shown(path: Path) -> Path:
    """Return the path relative to the current folder if it is inside of it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _learning_curve(run_dir: Path) -> tuple[CurvePoint, ...]:
    path = run_dir / "metrics.jsonl"
    try:
        history = read_history(path, sys.maxsize)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from None
    return learning_curve((line.env_steps, line.metrics) for line in history)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and evaluate.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0, or 1 where a success rate is below `--min-success`.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.evaluate", description=__doc__)
    cli.add_checkpoint_arguments(parser, several=True)
    parser.add_argument("--episodes", type=cli.whole_number(1, MOST_GOALS), default=REPORT_GOALS)
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="where the report goes, or of several runs or seeds the comparison",
    )
    parser.add_argument(
        "--robustness",
        action="store_true",
        help="judge on robots that differ from the preset too: friction, mass, motors, delay; and"
        " in C MuJoCo",
    )
    parser.add_argument(
        "--simulator",
        choices=get_args(Simulator),
        help="evaluate in another simulator too: mujoco is C MuJoCo, with other numerics than in"
        " training",
    )
    parser.add_argument(
        "--ranges",
        type=Path,
        metavar="FILE",
        help="configuration by whose randomization a robot is drawn for each goal, beside the"
        " preset's (default: the run's own, if it has any)",
    )
    parser.add_argument(
        "--min-success", type=cli.fraction, help="exit with 1 below this success rate"
    )
    options = parser.parse_args(arguments)
    cli.require_device()
    use_compilation_cache()
    if len(options.run) > 1 or seed_folders(Path(options.run[0])):
        return _main_comparison(options)
    report = run(
        options.run[0],
        episodes=options.episodes,
        which=options.checkpoint,
        output=options.output,
        robustness=options.robustness,
        ranges=options.ranges,
        simulator=options.simulator,
    )
    print(
        f"{report.policy.episodes} fixed goals (set {GOAL_SET_VERSION}), policy after"
        f" {report.env_steps:,} steps\n{policies_table({'policy': report})}\n"
        f"{best_known_lines(report)}{robustness_table(report)}"
        f"report: {report.folder / 'report.html'}"
    )
    if report.policy.nonfinite_envs:
        print(f"{report.policy.nonfinite_envs} episodes ended in a world that blew up")
    return _verdict({"": report.policy.success_rate}, options.min_success)


def _main_comparison(options: argparse.Namespace) -> int:
    comparison = run_comparison(
        options.run,
        episodes=options.episodes,
        which=options.checkpoint,
        output=options.output,
        robustness=options.robustness,
        ranges=options.ranges,
        simulator=options.simulator,
    )
    runs = comparison.runs
    policies = {
        seed if len(runs) == 1 else f"{run.name} {seed}" if len(run.seeds) > 1 else run.name: report
        for run in runs
        for seed, report in run.seeds.items()
    }
    print(
        f"{comparison.episodes} fixed goals (set {GOAL_SET_VERSION}), {len(policies)} policies\n"
        f"{policies_table(policies)}\n\n{runs_table(comparison)}"
    )
    if comparison.pairs:
        print(f"\n{pairs_table(comparison)}")
    print(f"report: {comparison.folder / 'comparison.html'}")
    rates = {run.name: run.success_rate.mean.value or 0.0 for run in runs}
    return _verdict(
        rates if len(runs) > 1 else {"": next(iter(rates.values()))}, options.min_success
    )


def _verdict(success_rates: Mapping[str, float], wanted: float | None) -> int:
    below = {name: rate for name, rate in success_rates.items() if rate < (wanted or 0.0)}
    for name, rate in below.items():
        print(
            f"{name + ': ' if name else ''}success {rate:.2%} is below the {wanted:.2%} asked for"
        )
    return BELOW_TARGET if below else 0


if __name__ == "__main__":
    cli.run_command(main)
