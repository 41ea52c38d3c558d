"""Evaluate the policies of runs on fixed goals, write their reports, and compare the runs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypedDict, Unpack, get_args

import jax

from jetbot_mjx import runs
from jetbot_mjx.config import Config, RandomizationConfig, load_config
from jetbot_mjx.envs import OTHER_NUMERICS, DomainRandomizationWrapper, JetBotEnv, Numerics
from jetbot_mjx.errors import InvalidError, UserError
from jetbot_mjx.evaluation.clips import ClipMaker, clip_goals
from jetbot_mjx.evaluation.comparison import Comparison, check_comparable, compare
from jetbot_mjx.evaluation.curves import CurvePoint, LossPoint, read_curve
from jetbot_mjx.evaluation.evaluate_returns import compare_return_runs, report_each, write_returns
from jetbot_mjx.evaluation.evaluator import BASELINES, Evaluator, report_keys, summarize
from jetbot_mjx.evaluation.goal_set import REPORT_GOALS
from jetbot_mjx.evaluation.html_report import write_comparison, write_report
from jetbot_mjx.evaluation.moments import MomentFinder
from jetbot_mjx.evaluation.report import (
    Report,
    by_goal,
    compare_times,
    find_failures,
)
from jetbot_mjx.evaluation.result_names import (
    comparison_folder,
    find_report,
    name_with_count,
    report_folder,
)
from jetbot_mjx.evaluation.return_report import ReturnComparison, ReturnReport
from jetbot_mjx.evaluation.robustness import SWEEP_GOALS, MujocoEvaluator, MujocoResult, Sweeper
from jetbot_mjx.runs import Checkpoint, JsonObject, Setup, Which, check_writable, load_checkpoint
from jetbot_mjx.terminal import stage

Simulator = Literal["mujoco"]
"""A simulator other than the one that policies are trained in."""

_FOLDER = "evaluations"


class ReportOptions(TypedDict, total=False):
    """The keyword arguments of `evaluate_run` and `compare_runs`."""

    episodes: int
    """Number of fixed goals, from the first on; by default `REPORT_GOALS`."""
    which: Which
    """Checkpoint of a run folder, of each seed; by default `best`."""
    output: str | Path | None
    """Folder to write; None: of a report the one in `evaluations/` of the run folder that
    `report_folder` chooses, so that no fuller report is replaced; of a comparison
    `evaluations/comparison/` of the first run, whose name ends with the number of goals if they are
    not as many as by default, and with a number if one of other runs lies there."""
    robustness: bool
    """Whether to evaluate also on robots that differ from the preset, and in C MuJoCo."""
    ranges: str | Path | None
    """Configuration file with ranges below `randomization`. A policy is evaluated also on one robot
    sampled from them for each goal. None: the ranges of the run, if any."""
    simulator: Simulator | None
    """Second simulator in which a policy is evaluated too, or None."""


def evaluate_run(
    run_or_checkpoint: str | Path,
    *,
    clips: ClipMaker | None = None,
    **options: Unpack[ReportOptions],
) -> Report | ReturnReport:
    """Evaluate one policy and write its report.

    Args:
      run_or_checkpoint: A run folder, or one of its checkpoint folders.
      clips: A function that renders the report's clips; None: it has none.
      **options: What to evaluate, and where to write it.

    Returns:
      The report, which names its folder: of returns, if the run has an `environment`.

    Raises:
      UserError: there is no usable checkpoint, an option is for robots and the run has an
        `environment`, or the folder cannot be written.
    """
    reporter = _Reporter(**options)
    checkpoint = load_checkpoint(run_or_checkpoint, reporter.which)
    if checkpoint.config.environment is not None:
        _check_returns(checkpoint.config, options)
        return write_returns(checkpoint, reporter.episodes, reporter.output)
    check_writable(Path(reporter.output or checkpoint.results_dir / _FOLDER))
    return reporter.write(checkpoint, checkpoint.make_setup(), reporter.output, clips=clips)


def evaluate_in_mujoco(
    run_or_checkpoint: str | Path,
    *,
    episodes: int = REPORT_GOALS,
    which: Which = "best",
    ranges: str | Path | None = None,
    numerics: Numerics = OTHER_NUMERICS,
) -> MujocoResult:
    """Evaluate one policy in C MuJoCo, without writing anything.

    A policy that sees is evaluated by the pictures of MuJoCo's renderer too.

    Args:
      run_or_checkpoint: A run folder, or one of its checkpoint folders.
      episodes: The number of fixed goals, from the first on.
      which: The checkpoint of a run folder.
      ranges: As for `evaluate_run`.
      numerics: The numerical settings of C MuJoCo.

    Returns:
      The metrics.

    Raises:
      UserError: there is no usable checkpoint, JAX was told to do without a CPU, or the policy
        sees and this machine has no OpenGL.
    """
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    robots = _read_ranges(ranges) or checkpoint.config.randomization
    evaluator = MujocoEvaluator(checkpoint.make_setup(), robots, numerics, pictures=True)
    return evaluator.run(checkpoint.params, report_keys(episodes))


def _check_returns(config: Config, options: ReportOptions) -> None:
    """Raise an error if options ask for what only robots have.

    Raises:
      InvalidError: one of them does.
    """
    for name in ("robustness", "simulator", "ranges"):
        if options.get(name):
            raise InvalidError(
                f"{name} is for robots, and the run has environment = {config.environment!r}:"
                f" leave out --{name}"
            )


def compare_runs(
    runs: Sequence[str | Path], **options: Unpack[ReportOptions]
) -> Comparison | ReturnComparison:
    """Evaluate the policies of several runs or seeds, write a report on each, and compare them.

    The report on a policy is not written again if there is one that is at least as full.

    Args:
      runs: Run folders, of one seed or several, or checkpoint folders.
      **options: What to evaluate, and where to write the comparison.

    Returns:
      The comparison, which names its folder. Each of its reports names its own.

    Raises:
      UserError: a checkpoint cannot be used or is named twice, the runs have different tasks or
        environments, or a folder cannot be written.
    """
    reporter = _Reporter(**options)
    # Load all policies and check that they can be compared.
    entries = _load_runs([Path(path) for path in runs], reporter.which)
    first = next(iter(entries.values())).folder
    seeds = {name: one.seeds for name, one in entries.items()}
    for entry in entries.values():
        if (config := entry.first.config).environment is not None:
            _check_returns(config, options)
            return compare_return_runs(seeds, first, reporter.episodes, reporter.output)
    check_comparable({name: entry.first.config for name, entry in entries.items()})
    name = name_with_count("comparison", reporter.episodes, REPORT_GOALS, "-goals")
    folder = Path(reporter.output or comparison_folder(first / _FOLDER, name, seeds))

    def write(checkpoint: Checkpoint, setup: Setup) -> Report:
        report = reporter.write(checkpoint, setup, again=False)
        # Drop the trajectories, which are large and already plotted.
        return report._replace(episodes=report.episodes._replace(qpos=None))

    by_run = report_each(seeds, folder, lambda checkpoint: checkpoint.results_dir / _FOLDER, write)
    comparison = compare(folder.absolute(), by_run)
    with stage("writing the comparison"):
        write_comparison(comparison)
    return comparison


def _read_ranges(path: str | Path | None) -> RandomizationConfig | None:
    """Read the ranges of `--ranges`, which replace those of every run."""
    if path is None:
        return None
    ranges = load_config(path, imports=False).randomization
    if not ranges.drawn:
        raise UserError(
            f"--ranges {path}: it randomizes nothing; give a configuration with ranges below"
            " `randomization`, such as configs/real_jetbot.yaml"
        )
    return ranges


class RunEntry(NamedTuple):
    """A `RunEntry` is a run that takes part in a comparison."""

    folder: Path
    seeds: Mapping[str, Checkpoint]

    @property
    def first(self) -> Checkpoint:
        """Return the policy of the first seed."""
        return next(iter(self.seeds.values()))


def _load_runs(paths: Sequence[Path], which: Which) -> dict[str, RunEntry]:
    """Load the runs and return them by a unique name."""
    entries: list[RunEntry] = []
    owners: dict[Path, Path] = {}
    for path in paths:
        folders = runs.seed_folders(path)
        seeds = {one.name: load_checkpoint(one, which) for one in folders or [path]}
        for checkpoint in seeds.values():
            place = checkpoint.path.resolve()
            if place in owners:
                raise UserError(
                    f"{path} and {owners[place]} are the same policy,"
                    f" {runs.shortened(checkpoint.path)}: name each once"
                )
            owners[place] = path
        first = next(iter(seeds.values()))
        entries.append(RunEntry(first.run_dir.parent if folders else first.results_dir, seeds))
    return dict(zip(_names(entries), entries, strict=True))


def _names(entries: Sequence[RunEntry]) -> list[str]:
    """Return the shortest unique end of each folder's path, with the steps if needed."""
    folders = [entry.folder for entry in entries]
    different = set(folders)
    length = 1
    while len({folder.parts[-length:] for folder in different}) < len(different):
        length += 1
    names = []
    for entry in entries:
        name = "/".join(entry.folder.parts[-length:])
        if folders.count(entry.folder) > 1:
            name += f" @ {entry.first.env_steps:,}"
        names.append(name)
    return names


class _Reporter:
    """A `_Reporter` evaluates policies and writes their reports.

    It keeps the compiled evaluators, and the baselines' metrics, as long as they fit the policies.
    """

    def __init__(
        self,
        *,
        episodes: int = REPORT_GOALS,
        which: Which = "best",
        output: str | Path | None = None,
        robustness: bool = False,
        ranges: str | Path | None = None,
        simulator: Simulator | None = None,
    ) -> None:
        """Take the options, as `ReportOptions` explains them."""
        if simulator not in (None, *get_args(Simulator)):
            raise InvalidError(f"simulator = {simulator!r} is unknown: give 'mujoco' or None")
        self.episodes, self.output = episodes, output
        self.which: Which = which
        self._keys, self._versions = report_keys(episodes), runs.versions()
        self._robustness, self._in_mujoco = robustness, robustness or simulator is not None
        self._pictures = simulator is not None
        self._ranges, self._ranges_file = _read_ranges(ranges), ranges
        self._built_for: tuple[object, ...] = ()

    def _build(self, checkpoint: Checkpoint, setup: Setup, ranges: RandomizationConfig) -> None:
        """Build the evaluators and evaluate the baselines, unless the present ones fit."""
        config, params = checkpoint.config, checkpoint.params
        env, networks, programs = setup.robot_env, setup.networks, setup.programs
        # The parts of a configuration that the compiled episodes depend on.
        parts = (
            config.task,
            type(env.task),
            config.robot,
            config.physics,
            config.deterministic,
            config.ppo.network,
            config.ppo.normalize_observations,
            ranges,
        )
        if parts == self._built_for:
            return
        self._nominal = Evaluator(env, networks, programs, baselines=True, record=True)
        self._baselines = {
            name: summarize(self._nominal.run(params, self._keys, name), env.dt)
            for name in BASELINES
        }
        self._randomized = None
        if ranges.drawn:
            varied = DomainRandomizationWrapper(env, ranges=ranges)
            self._randomized = Evaluator(varied, networks, programs)
        self._moments = MomentFinder(env, networks, programs) if env.camera else None
        self._mujoco = None
        if self._in_mujoco:
            self._mujoco = MujocoEvaluator(setup, ranges, pictures=self._pictures)
        self._built_for = parts

    def _parts(self, setup: Setup, ranges: RandomizationConfig) -> frozenset[str]:
        """Return the names of the parts that a report has beside the fixed goals."""
        has = {
            "robustness": self._robustness,
            "mujoco": self._in_mujoco,
            "rendered": self._pictures and setup.robot_env.camera is not None,
            "randomized": bool(ranges.drawn),
        }
        return frozenset(name for name, wanted in has.items() if wanted)

    def _on_other_robots(self, checkpoint: Checkpoint, setup: Setup) -> JsonObject:
        """Return the fields of a report about other robots and another simulator."""
        params, keys, found = checkpoint.params, self._keys, {}
        if self._robustness:
            sweeper = Sweeper(setup, keys[:SWEEP_GOALS])
            found["robustness"] = sweeper.run(params)
        if self._randomized:
            found["randomized"] = summarize(self._randomized.run(params, keys), setup.robot_env.dt)
        if self._mujoco:
            found["mujoco"] = self._mujoco.run(params, keys)
        return found

    def write(
        self,
        checkpoint: Checkpoint,
        setup: Setup,
        output: str | Path | None = None,
        *,
        again: bool = True,
        clips: ClipMaker | None = None,
    ) -> Report:
        """Evaluate a policy and write its report.

        Args:
          checkpoint: the policy.
          setup: its environment, networks and programs.
          output: the folder of the report; None: the one that `report_folder` chooses.
          again: whether to write a report also where there is one that is at least as full.
          clips: as for `evaluate_run`.
        """
        config, ranges = checkpoint.config, self._ranges or checkpoint.config.randomization
        env = setup.robot_env
        # Choose the folder of the report.
        parts = self._parts(setup, ranges)
        wanted = checkpoint.results_dir / _FOLDER, checkpoint.path.name, len(self._keys), parts
        fuller = None if again else find_report(*wanted)
        # Run the fixed goals, which most parts of the report are computed from.
        self._build(checkpoint, setup, ranges)
        finished = jax.device_get(self._nominal.run(checkpoint.params, self._keys))
        run_dir = runs.shortened(checkpoint.run_dir)
        history = runs.read_history(checkpoint.run_dir / runs.METRICS)
        report = Report(
            folder=Path(output or fuller or report_folder(*wanted)),
            run=run_dir,
            checkpoint=checkpoint.path,
            env_steps=checkpoint.env_steps,
            config=config,
            policy=summarize(finished, env.dt),
            baselines=self._baselines,
            goal_bins=by_goal(finished, env.dt),
            failures=find_failures(finished, run_dir, checkpoint.env_steps),
            learning_curve=read_curve(CurvePoint, history),
            losses=read_curve(LossPoint, history),
            episodes=finished,
            versions=self._versions,
            fallbacks=checkpoint.about.get("fallbacks", ()),
            ranges=ranges if ranges.drawn else None,
            ranges_file=None if self._ranges_file is None else Path(self._ranges_file),
            changes=runs.changes_since_the_run_before(checkpoint.run_dir),
            **compare_times(config, finished),
            seen=self._moments.find(checkpoint.params, self._keys, finished)
            if self._moments
            else (),
            **self._on_other_robots(checkpoint, setup),
        )
        if fuller is None:
            report = report if clips is None else _with_clips(report, env, clips)
            with stage("writing the report"):
                write_report(report)
        return report


def _with_clips(report: Report, env: JetBotEnv, make: ClipMaker) -> Report:
    """Return a report with clips, or with the reason why this machine cannot render them."""
    goals = clip_goals(report.episodes)
    try:
        with stage("clips"):
            return report._replace(clips=tuple(make(env, report.episodes, goals)))
    except UserError as error:
        return report._replace(clips_missing=str(error))
