"""Trains a policy into a run folder: `python -m jetbot_mjx.train --config configs/jetbot.yaml`."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from jetbot_mjx import brax_ppo, cli
from jetbot_mjx.brax_ppo import Progress
from jetbot_mjx.checkpoint import CheckpointWriter
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.env import JetBotEnv, make_env
from jetbot_mjx.evaluation import Evaluator, Summary, summarize, training_keys
from jetbot_mjx.metrics import (
    CompileClock,
    Figures,
    JsonlSink,
    ProgressSink,
    Sinks,
    TensorBoardSink,
)
from jetbot_mjx.policy import PolicyParams, make_networks
from jetbot_mjx.run_folder import check_free, create_run_folder, default_run_dir, versions

Trainer = Callable[[Config, JetBotEnv, Callable[[Progress], None]], PolicyParams]

TRAINERS: dict[str, Trainer] = {"brax": brax_ppo.train}
"""By the configuration's `trainer`: each trains and reports, and knows nothing of files."""


class Result(NamedTuple):
    """What a training leaves."""

    run_dir: Path
    best_steps: int
    """Environment steps of the best checkpoint."""
    best: Summary
    """Its figures on the training's own evaluation goals."""
    wall_seconds: float


def run(config: Config, run_dir: Path) -> Result:
    """Trains a policy.

    Args:
      config: the run.
      run_dir: the run folder to make; it must not be in use.

    Returns:
      Where it lies and how good it became.

    Raises:
      UserError: the folder is in use, the task cannot be built, or the devices cannot share
        the environments; nothing has been written then.
    """
    check_free(run_dir)
    config.check_devices(jax.device_count())
    env = make_env(config)
    create_run_folder(run_dir, config)
    print(_headline(config, run_dir), flush=True)
    sinks = Sinks(
        [
            JsonlSink(run_dir / "metrics.jsonl"),
            TensorBoardSink(run_dir / "tensorboard"),
            ProgressSink(config.ppo.num_timesteps),
        ]
    )
    writer = CheckpointWriter(run_dir, _about(config, env))
    with CompileClock() as clock, sinks, writer as checkpoints:
        monitor = _Monitor(config, env, clock)

        def report(progress: Progress) -> None:
            summary, figures = monitor.judge(progress)
            checkpoints.save(progress.env_steps, progress.params, summary._asdict())
            sinks.write(progress.env_steps, figures)

        TRAINERS[config.trainer](config, env, report)
    return Result(run_dir, monitor.best_steps, monitor.best, monitor.wall_seconds)


class _Monitor:
    """Judges what a trainer reports, and keeps the clocks and the best."""

    def __init__(self, config: Config, env: JetBotEnv, clock: CompileClock) -> None:
        networks = make_networks(
            config.ppo.network,
            env.observation_size,
            env.action_size,
            normalize=config.ppo.normalize_observations,
        )
        self._evaluator = Evaluator(env, networks)
        self._keys = training_keys(config.evaluation.episodes)
        self._config = config
        self._compile_clock = clock
        self._began = time.perf_counter()
        self._env_steps = 0
        self.best_steps = 0
        self.best: Summary

    def judge(self, progress: Progress) -> tuple[Summary, Figures]:
        """Figures of one report."""
        trainer_compiling = self._compile_clock.lap()
        episodes = self._evaluator.run(progress.params, self._keys)
        summary = summarize(episodes, self._config.physics.ctrl_dt)
        if progress.env_steps == 0 or summary.success_rate >= self.best.success_rate:
            self.best_steps, self.best = progress.env_steps, summary
        training_seconds = progress.seconds - trainer_compiling
        steps = progress.env_steps - self._env_steps
        self._env_steps = progress.env_steps
        figures = {
            **{f"eval/{name}": value for name, value in summary._asdict().items()},
            **self._losses(progress),
            "time/env_steps_per_second": steps / training_seconds if steps else None,
            "time/compile_seconds": trainer_compiling + self._compile_clock.lap(),
            "time/wall_seconds": self.wall_seconds,
        }
        return summary, figures

    @property
    def wall_seconds(self) -> float:
        """Since this training began [s]."""
        return time.perf_counter() - self._began

    def _losses(self, progress: Progress) -> Figures:
        """Brax's figures under this project's names."""
        brax = {name.removeprefix("training/"): value for name, value in progress.metrics.items()}
        figures = {ours: brax[theirs] for theirs, ours in _BRAX_NAMES.items() if theirs in brax}
        entropy_cost = self._config.ppo.entropy_cost
        if "entropy_loss" in brax and entropy_cost > 0:
            figures["policy/entropy"] = -brax["entropy_loss"] / entropy_cost
        return figures


_BRAX_NAMES = {
    "total_loss": "loss/total",
    "policy_loss": "loss/policy",
    "v_loss": "loss/value",
    "entropy_loss": "loss/entropy",
    "kl_mean": "policy/kl",
    "policy_dist_mean_std": "policy/std",
    "learning_rate": "policy/learning_rate",
}


def _about(config: Config, env: JetBotEnv) -> dict[str, object]:
    """What explains every checkpoint of a run."""
    return {
        "config": config.model_dump(mode="json"),
        "layout": [field._asdict() for field in env.task.layout],
        "observation_size": env.observation_size,
        "action_size": env.action_size,
        "ctrl_dt": env.dt,
        "versions": versions(),
    }


def _headline(config: Config, run_dir: Path) -> str:
    device = jax.devices()[0]
    return (
        f"training {config.task.name} ({config.robot.preset} robot,"
        f" {config.task.observation} observation) with the {config.trainer} trainer:"
        f" {config.ppo.num_timesteps:,} steps in {config.ppo.num_envs:,} environments on"
        f" {jax.device_count()} x {device.device_kind}\nrun folder: {run_dir}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line and trains.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.train", description=__doc__)
    parser.add_argument("--config", type=Path, required=True, help="YAML file, see configs/")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override one setting; may be given again",
    )
    parser.add_argument("--seed", type=int, help="the same as --set seed=N")
    parser.add_argument("--run-dir", type=Path, help="default: runs/<config>-<date>-<time>")
    options = parser.parse_args(arguments)
    cli.require_device()
    overrides = list(options.overrides)
    if options.seed is not None:
        overrides.append(f"seed={options.seed}")
    config = load_config(options.config, overrides)
    result = run(config, options.run_dir or default_run_dir(options.config))
    print(
        f"best policy: {result.best.success_rate:.1%} success at {result.best_steps:,} steps;"
        f" {result.wall_seconds:.1f} s in all\n"
        f"next: python -m jetbot_mjx.evaluate {result.run_dir}\n"
        f"      python -m jetbot_mjx.render {result.run_dir}\n"
        f"      tensorboard --logdir {result.run_dir}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
