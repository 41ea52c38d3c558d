"""Train, evaluate, render and tune from Python: what the commands of these names do, as functions.

A program that imports the package keeps its process to itself. These functions print nothing unless
asked, raise a `UserError` where a command exits, and leave signals, imports, log levels and JAX's
settings as they are. They work in a notebook and in any thread.
"""

import contextlib
import functools
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack, overload

from jetbot_mjx import deployment, evaluation, runs, training, tuning, viewers
from jetbot_mjx.config import Config, Overrides, load_config
from jetbot_mjx.devices import require_device
from jetbot_mjx.errors import InvalidError, UserError, check_count, check_path, check_size, ran_out
from jetbot_mjx.runs import (
    check_resumed,
    claim_run_dir,
    find_run,
    find_run_config,
    seed_folders,
    trusting,
)
from jetbot_mjx.terminal import restart_clock, show_progress

if TYPE_CHECKING:
    from jetbot_mjx.agents import Policy
    from jetbot_mjx.runs import Which

    _Evaluated = (
        evaluation.Report
        | evaluation.ReturnReport
        | evaluation.Comparison
        | evaluation.ReturnComparison
    )

_FITTING = {
    "strip": ("many",),
    "gallery": ("episodes", "size"),
    "many": ("which", "size"),
    "goals": ("which", "size"),
    "episodes": ("which", "size"),
}
"""The arguments of `render` that say what to render, with those that may be given beside them."""


def train(
    config: str | Path | Config | None = None,
    overrides: Overrides = (),
    *,
    run_dir: str | Path | None = None,
    resume: str | Path | None = None,
    trust: bool = False,
    verbose: bool = False,
) -> "training.Result":
    """Train a policy, from the beginning or from where the run in the folder was stopped.

    Ctrl-C, or *Interrupt the kernel* in a notebook, saves the training and then raises a
    KeyboardInterrupt; the same call, or `resume`, continues it.

    Args:
      config: a configuration: its name, its file or the object.
      overrides: the settings to change, such as `{"ppo.num_envs": 512}`.
      run_dir: the run folder: a new one, or that of a run with this configuration. None: a new one,
        `runs/<config>-<date>-<time>`.
      resume: a run to continue with its own configuration, in place of `config` and `run_dir`.
      trust: whether to run the code that a run to continue names, whoever wrote it.
      verbose: whether to show the progress.

    Returns:
      The run folder, the metrics of its best checkpoint, and more.

    Raises:
      UserError: a setting or argument is wrong, the folder cannot be used, or a device has too
        little memory.
    """
    if resume is not None:
        if config is not None or run_dir is not None:
            raise InvalidError(
                f"resume = {str(resume)!r} continues a run with its configuration in its folder:"
                " leave out config and run_dir"
            )
    elif config is None:
        raise InvalidError('give a configuration, as in train("jetbot"), or a run to resume')
    with _ready(verbose, trust, run_dir=run_dir):
        restart_clock()
        if resume is not None:
            run_dir = find_run(resume)
            config = find_run_config(run_dir)
            checked = load_config(config, overrides)
            check_resumed(run_dir, config, checked)
        else:
            assert config is not None
            checked = load_config(config, overrides)
        with claim_run_dir(run_dir, _name(config)) as folder:
            return training.run(checked, folder, verbose=verbose)


@overload
def evaluate(
    runs: str | Path,
    *,
    trust: bool = ...,
    verbose: bool = ...,
    **options: "Unpack[evaluation.ReportOptions]",
) -> "evaluation.Report | evaluation.ReturnReport": ...
@overload
def evaluate(
    runs: Sequence[str | Path],
    *,
    trust: bool = ...,
    verbose: bool = ...,
    **options: "Unpack[evaluation.ReportOptions]",
) -> "evaluation.Comparison | evaluation.ReturnComparison": ...
def evaluate(
    runs: str | Path | Sequence[str | Path],
    *,
    which: "Which" = "best",
    episodes: int = 1024,
    output: str | Path | None = None,
    robustness: bool = False,
    ranges: str | Path | None = None,
    simulator: "evaluation.Simulator | None" = None,
    trust: bool = False,
    verbose: bool = False,
) -> "_Evaluated":
    """Evaluate a policy on the fixed goals and write its report, or compare several runs.

    Args:
      runs: one run or checkpoint, which gets a report; or a list of runs, of one seed or several,
        which are compared as well. A run is named by its folder or as for the commands: `latest`, a
        folder in `runs/`, or `pretrained:NAME`.
      which: the checkpoint of a run: `"best"`, `"last"` or a number of steps.
      episodes: the number of fixed goals, from the first on.
      output: the folder of the report or comparison; None: one in `evaluations/` of the run.
      robustness: whether to evaluate also on robots that differ from the preset, and in C MuJoCo.
      ranges: a configuration file with ranges below `randomization`: evaluate also on one robot
        sampled from them for each goal. None: the ranges of the run, if any.
      simulator: `"mujoco"` to evaluate also in C MuJoCo.
      trust: whether to run the code that the runs name, whoever wrote it.
      verbose: whether to show the progress.

    Returns:
      The report of one run, or the comparison of a list of runs; of returns, where the runs have an
      `environment`. Both name the folder of their files.

    Raises:
      UserError: a run or argument is wrong, runs cannot be compared, or a folder not be written.
    """
    options: evaluation.ReportOptions = {
        "which": which,
        "episodes": episodes,
        "output": output,
        "robustness": robustness,
        "ranges": ranges,
        "simulator": simulator,
    }
    with _ready(verbose, trust, output=output, ranges=ranges):
        if isinstance(runs, bytes) or hasattr(runs, "run_dir"):  # a training's result is a tuple
            check_path("runs", runs)
        if not isinstance(runs, str | Path):
            if not isinstance(runs, Iterable):
                raise InvalidError(f"runs = {runs!r} is wrong: name a run, or several in a list")
            found = [find_run(run) for run in runs]
            if not found:
                raise InvalidError("runs = [] is empty: name at least one run")
            return evaluation.compare_runs(found, **options)
        run = find_run(runs)
        if seed_folders(run):
            raise InvalidError(
                f"{run} holds several seeds: name one of them, or compare all in a list, as in"
                f" evaluate([{str(run)!r}])"
            )
        return evaluation.evaluate_run(run, clips=viewers.make_clips, **options)


def render(
    run: str | Path,
    *,
    which: "Which" = "best",
    episodes: int | None = None,
    goals: Sequence[int] | None = None,
    many: int | None = None,
    gallery: bool = False,
    strip: bool = False,
    size: tuple[int, int] | None = None,
    trust: bool = False,
    verbose: bool = False,
) -> "viewers.Rendered":
    """Render a policy that drives to the fixed goals: a video, a GIF and a plot.

    Args:
      run: a run or checkpoint, named as for `evaluate`.
      which: the checkpoint of a run: `"best"`, `"last"` or a number of steps.
      episodes: the number of goals, from the first on (default: 8, of a gallery 4); in an
        `environment` that of episodes (default: 3).
      goals: these of the fixed goals, such as `[3, 17]`, in place of `episodes`.
      many: that many robots in one scene, each with its own goal.
      gallery: whether to render the first, the middle and the last checkpoint side by side.
      strip: whether to draw an untrained, an early and a trained policy, `many` robots of each.
      size: width and height of the video [pixels] (default: 1280, 720; of a gallery 1280, 480).
      trust: whether to run the code that the run names, whoever wrote it.
      verbose: whether to show the progress.

    Returns:
      The files, and how many goals were reached.

    Raises:
      UserError: a run or argument is wrong, arguments exclude each other, there is no OpenGL, or a
        folder cannot be written.
    """
    given = {
        "strip": strip,
        "gallery": gallery,
        "many": many is not None,
        "goals": goals is not None,
        "episodes": episodes is not None,
        "which": which != "best",
        "size": size is not None,
    }
    chosen = next((name for name in _FITTING if given[name]), "episodes")
    for name in given:
        if given[name] and name not in (chosen, *_FITTING[chosen]):
            raise InvalidError(f"render: {chosen} and {name} exclude each other")
    if size is not None:
        check_size(size)
    with _ready(verbose, trust):
        path = find_run(run)
        if strip:
            return viewers.render_training_strip(path, robots=16 if many is None else many)
        if gallery:
            episodes = 4 if episodes is None else episodes
            return viewers.render_gallery(path, episodes=episodes, size=size)
        if many is not None:
            return viewers.render_many(path, robots=many, which=which, size=size)
        return viewers.render_run(path, episodes=episodes, goals=goals, which=which, size=size)


def tune(
    config: str | Path | Config,
    overrides: Overrides = (),
    *,
    space: str | Path | Mapping[str, object],
    trials: int = 64,
    round_size: int = 16,
    confirm: int = 3,
    objective: "tuning.Objective" = "learning",
    output: str | Path | None = None,
    storage: str | None = None,
    verbose: bool = False,
) -> "tuning.TuningResult":
    """Search for hyperparameters, many trials at once.

    The same call with the same `output` continues a search that was stopped.

    Args:
      config: a configuration: its name, its file or the object.
      overrides: the settings to change before the search, such as `{"ppo.num_envs": 512}`.
      space: the settings to search and their values, such as `{"ppo.learning_rate": {"low": 1e-4,
        "high": 1e-2, "log": True}}`; the YAML file that holds them; or `"ppo"` or `"time"`, which
        come with the package.
      trials: how many trials the study shall have.
      round_size: how many trials to train at once.
      confirm: how many of the best trials to retrain with five new seeds, beside the configuration
        as given; 0: none, and the best trial is the best.
      objective: what to improve: `learning`, the mean success while learning, or `time`, the time
        to the goals of policies that reach 99.9 % of them.
      output: the folder of the study and its results; None: a new one,
        `runs/tune-<config>-<date>-<time>`.
      storage: the database of the study; None: SQLite in the folder.
      verbose: whether to show the progress.

    Returns:
      The best configuration, and all final trainings.

    Raises:
      UserError: a setting or argument is wrong, Optuna is not installed, or the folder or storage
        cannot be used.
    """
    check_count("trials", trials)
    check_count("round_size", round_size, 1024)
    if confirm:
        check_count("confirm", confirm)
    base = load_config(config, overrides)
    parameters = tuning.read_space(space, base)
    name = Path(f"tune-{_name(config).stem}")
    with _ready(verbose, output=output, storage=storage), claim_run_dir(output, name) as folder:
        return tuning.run_search(
            base,
            parameters,
            folder,
            trials=trials,
            round_size=round_size,
            confirm=confirm,
            objective=objective,
            storage=storage,
            say=functools.partial(print, flush=True) if verbose else lambda text: None,
        )


def _name(config: str | Path | Config) -> Path:
    """Return the name of a configuration, as of its file."""
    if isinstance(config, Config):
        return Path("run")
    check_path("config", config)
    return Path(config)


@contextlib.contextmanager
def _ready(verbose: bool, trust: bool = False, **paths: object) -> Iterator[None]:
    """Check paths and device; show progress and trust runs inside the context if asked to.

    Args:
      verbose: whether to show the progress.
      trust: whether to trust runs.
      **paths: arguments that are paths, or None, by their names.

    Raises:
      UserError: an argument is no path, JAX has no usable device, or it has too little memory.
    """
    for name, path in paths.items():
        if path is not None:
            check_path(name, path)
    require_device()
    with contextlib.ExitStack() as stack:
        stack.enter_context(trusting(trust))
        if verbose:
            restart_clock()
            stack.enter_context(show_progress(sys.stderr))
        try:
            yield
        # JAX raises a subclass.
        except RuntimeError as error:
            if not ran_out(error):
                raise
            raise UserError(
                "the device's memory does not suffice: choose fewer episodes, robots or trials"
            ) from error


def load_policy(run_or_checkpoint: str | Path, which: "Which" = "best") -> "Policy":
    """Read a policy and return it as a function of the observation.

    Args:
      run_or_checkpoint: a run folder, one checkpoint folder of it, or a folder with the files of
        `export --format numpy`, which pages write too; such a policy is deterministic.
      which: the checkpoint of a run folder.

    Returns:
      `policy(obs, key=None) -> action`, which is deterministic without a key. It raises an
      `InvalidError` if the observation has another length than that of the training.

    Raises:
      UserError: there is no usable policy.
    """
    check_path("run_or_checkpoint", run_or_checkpoint)
    folder = Path(run_or_checkpoint)
    if (folder / "policy.json").is_file() and (folder / "policy.py").is_file():
        return deployment.read_exported(folder)
    return runs.load_policy(run_or_checkpoint, which)
