"""Find runs by name, list them, and copy those that come with the package.

A run may be named by its path, by its folder's name in `runs/`, as `latest`, as `pretrained:NAME`
if it comes with the package, or as `hf:USER/NAME` if it is on the Hugging Face Hub.
"""

import difflib
import math
import os
import shlex
import shutil
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from jetbot_mjx.config import Config, run_around
from jetbot_mjx.errors import (
    NotFoundError,
    UnreadableError,
    UserError,
    check_path,
    clipped,
    os_errors,
    printable,
)
from jetbot_mjx.runs import hub
from jetbot_mjx.runs.metrics import METRICS, History, read_history
from jetbot_mjx.runs.run_dir import (
    CONFIG,
    DamagedRunError,
    JsonObject,
    atomic_folder,
    is_occupied,
    read_config,
    shortened,
)
from jetbot_mjx.runs.trust import require_trust
from jetbot_mjx.terminal import text_table

ROOT = Path("runs")
"""The folder in which trainings create their run folders, relative to the current folder."""

PRETRAINED = Path(__file__).parents[1] / "assets" / "pretrained"
"""Runs that come with the package, each named after its configuration."""

_LATEST = "latest"
_PREFIX = "pretrained:"
_HUB = "hub"


Unusable = DamagedRunError | UnreadableError
"""Why a list has no line of a run."""


State = Literal["running", "complete", "reached", "stopped"]
"""What a run is doing: a living process trains it; it made all its steps; it ended before, because
it reached `stop_at_success` or `stop_at_return`; or it was stopped, whoever did that."""

_MARKS: dict[State, str] = {"running": " running", "complete": "", "reached": " +", "stopped": " *"}
"""What follows the steps of a run in a list."""

_FOOTNOTES: dict[State, str] = {
    "reached": "+ reached stop_at_success or stop_at_return before its last step",
    "stopped": "* stopped before its last step: train --resume RUN continues it",
}


class RunInfo(NamedTuple):
    """A `RunInfo` holds what a list of runs says about one of them."""

    path: Path
    task: str
    """Name of the task, with the robot's preset and the observation; or of the environment."""
    env_steps: int
    """Environment steps of the last line of its log."""
    num_timesteps: int
    """Environment steps it was asked to train for."""
    seeds: int
    success_rate: float | None
    """Success rate of the best evaluation, of several seeds the mean; None before the first one, or
    if none is told."""
    episode_return: float | None
    """Mean return of the best evaluation in an `environment`, likewise; None for a robot."""
    changed: float
    """Time of the last line of its log [s since 1970]."""
    state: State
    """Whether it is being trained, and otherwise why its training ended."""

    @property
    def name(self) -> str:
        """Return the shortest name by which commands find the run."""
        return _shortest_name(self.path)

    def to_json(self) -> JsonObject:
        """Return the name and all fields as JSON values."""
        return {"name": self.name, **self._asdict(), "path": str(self.path)}


def _shortest_name(path: Path) -> str:
    if path.parent == PRETRAINED:
        return _PREFIX + path.name
    return path.name if path.parent == ROOT else str(path)


def find_run(name: str | Path, root: Path = ROOT, say: Callable[[str], None] | None = None) -> Path:
    """Return the path of a run or of a checkpoint, which need not exist.

    Args:
      name: a path; the name of a folder in `root`; `latest`; `pretrained:NAME`; or
        `hf:USER/NAME[@REVISION]`, which is downloaded to `root/hub/`.
      root: the folder of runs.
      say: a function that prints which revision was downloaded.

    Raises:
      NotFoundError: there is no latest run, or none of this name comes with the package or is on
        the Hub.
      InvalidError: it is neither a text nor a path.
      UserError: as for `download_run`.
    """
    check_path("run", name)
    text = str(name)
    if text.startswith(hub.PREFIX):
        return hub.download_run(text, root / _HUB, say)
    if text.startswith(_PREFIX):
        known = sorted(path.name for path in PRETRAINED.iterdir())
        if (own := text.removeprefix(_PREFIX)) in known:
            return PRETRAINED / own
        names = ", ".join(known)
        raise NotFoundError(f"{text} does not come with the package: there are {names}")
    if os.path.lexists(text):
        return Path(name)
    if text == _LATEST:
        runs, unusable = scan_runs(root)
        reason = f"there is no run in {root}/: train one first"
        for one in reversed(unusable):
            if isinstance(one, UnreadableError):
                raise one
            reason = f"every run in {root}/ is damaged, such as {one.run_dir.name}: {one.reason}"
        if runs:
            return runs[0].path
        raise NotFoundError(f"{_LATEST}: {reason}")
    if Path(text).name == text and os.path.lexists(root / text):
        return root / text
    return Path(name)


def find_run_config(run_dir: Path) -> Config:
    """Return the configuration of the run in a folder, which is to be continued.

    Raises:
      NotFoundError: there is no run in the folder.
      DamagedRunError: as for `read_config`.
      UserError: the folder cannot be read; or as for `require_trust`.
    """
    with os_errors(f"--resume {run_dir} cannot be read"):
        try:
            os.lstat(run_dir / CONFIG)
        except (FileNotFoundError, NotADirectoryError):
            hint = suggest_run(run_dir, "a run folder")
            message = f"--resume {run_dir}: there is no run in this folder; {hint}"
            raise NotFoundError(message) from None
    config = read_config(run_dir)
    require_trust(run_dir, config)
    return config


def scan_runs(root: Path = ROOT) -> tuple[list[RunInfo], list[Unusable]]:
    """Return the runs in the subfolders of a folder, the latest first, and the others' errors.

    Args:
      root: the folder, which may be missing.

    Raises:
      UserError: the folder cannot be read.
    """
    with os_errors(f"{root} cannot be read"):
        if not root.is_dir():
            return [], []
        folders = sorted(root.iterdir())
    runs, damaged = [], []
    for folder in folders:
        if any(os.path.lexists(folder / name) for name in (CONFIG, METRICS)):
            try:
                runs.append(read_info(folder))
            except (DamagedRunError, UnreadableError) as error:
                damaged.append(error)
    return sorted(runs, key=lambda run: -run.changed), damaged


def read_info(run_dir: Path) -> RunInfo:
    """Return what a list says about the run in a folder.

    Raises:
      DamagedRunError: its configuration or its metrics cannot be read.
      UnreadableError: the drive does not answer.
    """
    config = read_config(run_dir)
    try:
        files = sorted(run_dir.glob(f"seed-*/{METRICS}")) or [run_dir / METRICS]
        histories = [read_history(file) for file in files]
        history = min(histories, key=lambda lines: lines[-1].env_steps if lines else 0)
        changed = history[-1].timestamp if history else (run_dir / CONFIG).stat().st_mtime
    except UnreadableError:
        raise
    except (UserError, OSError) as error:
        raise DamagedRunError(run_dir, str(error)) from None
    # The list has room for a name only: a run's own page and `config.yaml` have the measures.
    name, differs, _ = config.robot.label.partition(" with ")
    robot = f"{name}, changed" if differs else name
    task = f"{clipped(config.task.name, 60)} {robot} {config.task.observation}"
    own = config.environment
    return RunInfo(
        path=run_dir,
        task=task if own is None else clipped(own, 60),
        env_steps=history[-1].env_steps if history else 0,
        num_timesteps=config.ppo.num_timesteps,
        seeds=len(histories),
        success_rate=_mean_best(histories, "eval/success_rate", 0.0, 1.0),
        episode_return=_mean_best(histories, "eval/episode_return") if own else None,
        changed=changed,
        state=_state(run_dir, config, histories),
    )


def _state(run_dir: Path, config: Config, histories: Sequence[Sequence[History]]) -> State:
    if is_occupied(run_dir):
        return "running"
    if all(lines and lines[-1].env_steps >= config.ppo.num_timesteps for lines in histories):
        return "complete"
    targets = {
        "eval/success_rate": config.stop_at_success,
        "eval/episode_return": config.stop_at_return,
    }
    reached = all(
        lines
        and any(
            target is not None and value is not None and value >= target
            for metric, target in targets.items()
            for value in [lines[-1].metrics.get(metric)]
        )
        for lines in histories
    )
    return "reached" if reached else "stopped"


def _mean_best(
    histories: Sequence[Sequence[History]],
    metric: str,
    least: float = -math.inf,
    most: float = math.inf,
) -> float | None:
    """Return the mean over all seeds of the best value of a metric; None if one has none."""
    every = [
        [
            x
            for line in history
            if (x := line.metrics.get(metric)) is not None and least <= x <= most
        ]
        for history in histories
    ]
    return statistics.fmean(map(max, every)) if all(every) else None


def runs_table(runs: Sequence[RunInfo], damaged: Sequence[Unusable] = ()) -> str:
    """Return a list of runs as text, one line each, or a line that says there are none.

    Args:
      runs: the runs.
      damaged: the errors of runs that cannot be read, which follow with the reason.
    """
    rows = [("run", "task", "steps", "success", "age")]
    rows += [
        (
            run.name,
            run.task,
            f"{run.env_steps:,}{_MARKS[run.state]}",
            format_score(run),
            _age(time.time() - run.changed),
        )
        for run in runs
    ]
    lines = [text_table(rows, left=2)]
    if not runs:
        lines = ["no runs here: train one, or use one that comes with the package: pretrained:NAME"]
    found = {run.state for run in runs}
    lines += [line for state, line in _FOOTNOTES.items() if state in found]
    return "\n".join([*lines, *(printable(_why_not(one)) for one in damaged)])


def _why_not(error: Unusable) -> str:
    if isinstance(error, UnreadableError):
        return str(error)
    return f"damaged: {_shortest_name(error.run_dir)}: {error.reason}"


def format_score(run: RunInfo) -> str:
    """Return the success rate of a run, or its return where it has none."""
    seeds = f" ({run.seeds} seeds)" if run.seeds > 1 else ""
    if run.success_rate is not None:
        return f"{run.success_rate:.1%}{seeds}"
    return "-" if run.episode_return is None else f"return {run.episode_return:.1f}{seeds}"


def copy_pretrained(folder: Path) -> tuple[Path, ...]:
    """Copy the runs that come with the package, without overwriting anything.

    Commands that take `pretrained:NAME` write pages and reports into the same folders: they stay.

    Args:
      folder: The folder in which each run gets a folder of its own.

    Returns:
      The run folders, named after their configurations. Each is complete or absent.

    Raises:
      UserError: one of them exists already, or cannot be written.
    """
    runs = {path: folder / path.name for path in sorted(PRETRAINED.iterdir())}
    for source, target in runs.items():
        parts = [target / path.name for path in source.iterdir()]
        if target.is_file() or any(map(os.path.lexists, parts)):
            raise UserError(f"{target} exists already: choose another folder with --output")
    for source, target in runs.items():
        # A folder that is there already holds results, and stays.
        new = target / "checkpoints" if target.exists() else target
        with atomic_folder(new) as unfinished:
            if new == target:
                shutil.copytree(source, unfinished, dirs_exist_ok=True)
            else:  # without checkpoints it is no run: they come last
                others = shutil.ignore_patterns("checkpoints")
                shutil.copytree(source, target, ignore=others, dirs_exist_ok=True)
                shutil.copytree(source / "checkpoints", unfinished, dirs_exist_ok=True)
    return tuple(runs.values())


def explain_missing(path: Path) -> str:
    """Return why a path is not a folder, and what to give instead; nothing if it is one.

    Raises:
      OSError: the path cannot be looked up.
    """
    if path.is_dir():
        return ""
    what = "a file" if path.is_file() else "no such folder"
    return f"{what}; {suggest_run(path)}"


_RUN = "a run folder, a checkpoint in it, or a name that `jetbot-mjx runs` lists"


def suggest_run(path: Path, what: str = _RUN) -> str:
    """Return a remedy for a path at which there is no run.

    A similar name is offered: the newest run whose name begins with the path's, at best with a
    hyphen after it, as in the names that trainings give; else the name that is closest.

    Args:
      path: the path.
      what: what to give instead, if no name is similar.
    """
    trained = [run.path.name for run in scan_runs()[0]]
    names = [_LATEST, *trained, *(f"{_PREFIX}{one.name}" for one in PRETRAINED.iterdir())]
    if path.name == _PREFIX[:-1]:
        return f"write {_PREFIX}NAME, as in {names[-1]}"
    if (run := run_around(path)) and run != path:
        return f"did you mean {shlex.quote(str(shortened(run)))}?"
    for start in (f"{path.name}-", path.name):
        if path.name and (newest := next((x for x in trained if x.startswith(start)), None)):
            return f"did you mean {shlex.quote(newest)}?"
    if close := difflib.get_close_matches(path.name, names, n=1):
        return f"did you mean {close[0]}?"
    return f"give {what}"


def _age(seconds: float) -> str:
    """Return a duration in the largest unit of which there is at least one."""
    for unit, size in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
