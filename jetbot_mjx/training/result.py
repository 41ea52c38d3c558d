"""Hold what a training came to, and say it in words."""

import importlib.util
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jetbot_mjx import runs
from jetbot_mjx.config import Config
from jetbot_mjx.evaluation import ReturnSummary, Summary
from jetbot_mjx.runs import checkpoint_steps
from jetbot_mjx.training.run_recorder import Standing


class Result(NamedTuple):
    """A `Result` holds the result of a training; of several processes only the first has it all."""

    run_dir: Path
    run_dirs: Sequence[Path]
    """The folder of each seed, which is the run folder if there is only one seed."""
    standings: list[Standing]
    """The progress of each seed; empty in all processes but the first."""
    fingerprints: list[str]
    """SHA-256 of each seed's last parameters, which are the same for the same seed; empty in all
    processes but the first."""
    finished: bool
    """Whether the training came to its end; otherwise the same command resumes it."""
    wall_seconds: float
    """Time spent on the training, in all processes [s]."""
    next_commands: Sequence[str] = ("evaluate", "render", "play")
    """Commands for its policies, the first of which takes several seeds."""
    ended_early: str = ""
    """Which target ended it before its last step, as a line; empty if none did."""

    def __repr__(self) -> str:
        """Return the folder and the best evaluation of each seed in one line."""
        scores = [_told_score(one.best) if one.best else "-" for one in self.standings]
        return (
            f"Result(run_dir={str(self.run_dir)!r}, best={', '.join(scores) or '-'},"
            f" finished={self.finished})"
        )

    @property
    def history(self) -> list[runs.History]:
        """Return the metrics of the first seed, one entry for each line of its `metrics.jsonl`."""
        return runs.read_history(self.run_dirs[0] / runs.METRICS)

    @property
    def best(self) -> Summary | ReturnSummary:
        """Return the metrics of the first seed's best checkpoint."""
        assert self.standings[0].best is not None
        return self.standings[0].best

    @property
    def best_steps(self) -> int:
        """Return the environment steps of the first seed's best checkpoint."""
        return self.standings[0].best_steps


def closing_message(result: Result) -> str:
    """Return the text that a training prints at last."""
    if result.finished:
        return summary(result)
    return stop_message(result.run_dir, result.run_dirs)


def summary(result: Result) -> str:
    """Return the text that is printed at the end of a training."""
    lines = []
    for standing, folder, fingerprint in zip(
        result.standings, result.run_dirs, result.fingerprints, strict=True
    ):
        assert standing.best is not None
        seed = f"{folder.name}, " if folder != result.run_dir else ""
        lines.append(
            f"{seed}best policy: {_told_score(standing.best)} at"
            f" {standing.best_steps:,} steps; last parameters: sha256 {fingerprint}"
        )
    if len(lines) > 1:
        lines.append(_told_mean([one.best for one in result.standings if one.best]))
    if result.ended_early:
        lines.append(result.ended_early)
    first = shlex.quote(str(result.run_dirs[0]))
    lines += [
        f"total {result.wall_seconds:.1f} s",
        f"next: jetbot-mjx {result.next_commands[0]} {shlex.quote(str(result.run_dir))}",
        *(f"      jetbot-mjx {command} {first}" for command in result.next_commands[1:]),
    ]
    if importlib.util.find_spec("tensorboard") is not None:
        # TensorBoard names runs by their folder below this one.
        lines.append(f"      tensorboard --logdir {shlex.quote(str(result.run_dir.parent))}")
    return "\n".join(lines)


def _told_score(best: Summary | ReturnSummary) -> str:
    """Return in words the number by which the best checkpoint was found."""
    if best.success_rate is None:
        return f"return {best.episode_return:.1f}"
    return f"{best.success_rate:.1%} success"


def _told_mean(best: Sequence[Summary | ReturnSummary]) -> str:
    """Return the line about the mean of all seeds, with its interval if that says something."""
    # Its statistics take half a second to import.
    from jetbot_mjx.evaluation import FEW_SEEDS, bootstrap

    form, what = "{:.2%}", "success"
    if best[0].success_rate is None:
        form, what = "{:.1f}", "return"
    scores = [one.score for one in best]
    text = f"{len(best)} seeds: {form.format(np.mean(scores))} {what} in the mean"
    # Two seeds miss the true value every second time, and equal ones leave no width.
    if len(best) < 3 or min(scores) == max(scores):
        return text
    interval = bootstrap(np.mean, scores)
    narrow = ", too narrow for so few seeds" if len(best) < FEW_SEEDS else ""
    low, high = form.format(interval.low), form.format(interval.high)
    return f"{text} (95 % interval {low} .. {high}{narrow})"


def stop_message(run_dir: Path, run_dirs: Sequence[Path]) -> str:
    """Return the line about a training that was stopped, and the folder of each of its seeds."""
    if not all(map(checkpoint_steps, run_dirs)):
        return "stopped before the first checkpoint: the same command starts from the beginning"
    return f"stopped; to resume: jetbot-mjx train --resume {shlex.quote(str(run_dir))}"


def complete_message(config: Config, standings: Sequence[Standing]) -> str:
    """Return the line about a run that has nothing left to train, and how to train it further."""
    steps = min(standing.env_steps for standing in standings)
    setting = "ppo.num_timesteps"
    if steps < config.ppo.all_steps:
        setting = "stop_at_success" if config.stop_at_return is None else "stop_at_return"
    return f"complete after {steps:,} steps; raise {setting} to train further"


def target_message(config: Config, standings: Sequence[Standing]) -> str:
    """Return the line about the target that ended a complete training; empty if it made all steps.

    Args:
      config: the configuration of the run.
      standings: the progress of each seed of a run that is complete.
    """
    steps = min(standing.env_steps for standing in standings)
    if steps >= config.ppo.all_steps:
        return ""
    targets = {"stop_at_success": config.stop_at_success, "stop_at_return": config.stop_at_return}
    told = [f"{key} = {value:g}" for key, value in targets.items() if value is not None]
    return f"{' or '.join(told)} reached at {steps:,} steps"
