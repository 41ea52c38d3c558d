"""Measure the cost of logs and checkpoints.

    python benchmarks/throughput/logging_cost.py --config configs/jetbot_egocentric.yaml

The same compiled training runs repeatedly and in turn in three modes: without a recorder; with the
logs of `jetbot-mjx train` (metrics.jsonl, TensorBoard, the terminal and its dashboard);
and with logs and checkpoints, which are saved in the background. No mode runs evaluations.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.measurements import IntervalTimer
from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.envs.jetbot_env import make_jetbot_env
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.metrics import CompileClock
from jetbot_mjx.runs.run_dir import write_json
from jetbot_mjx.training import composition, ppo_trainer, session
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.preemption import Preemption
from jetbot_mjx.training.run_recorder import RunRecorder

_NO_EVALUATION = Summary(1, 0, 0.0, 0.0, 1.0, None, None, None, 0.0, 1.0, 0)

MODES = {"off": "no recorder", "logs": "logs", "saved": "logs, checkpoints"}
"""The description of each mode, by its name."""


class _Timed(TrainerCallback):
    """A callback that forwards reports, and records when their processing has ended."""

    def __init__(self, recorder: TrainerCallback) -> None:
        self._recorder = recorder
        self.began = self.ended = 0.0

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        should_continue = self._recorder.on_interval(progress)
        # Timing starts at the end of the first report, after all compilation.
        self.ended = time.perf_counter()
        self.began = self.began or self.ended
        return should_continue

    def on_progress(self, env_steps: int, metrics: Mapping[str, float], seconds: float) -> None:
        self._recorder.on_progress(env_steps, metrics, seconds)


class _LogsAndCheckpoints(RunRecorder):
    """A recorder that runs no evaluations."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.evaluate = lambda params: _NO_EVALUATION


def _save_nothing(*_: Any, **__: Any) -> None:
    """Replace the method that saves a checkpoint."""


class _LogsOnly(_LogsAndCheckpoints):
    """A recorder that runs no evaluations and saves no checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for seed in self.seeds:
            seed.save = _save_nothing


def measure(config: Config, repeats: int) -> dict[str, list[float]]:
    """Time the training in all modes.

    Args:
      config: The configuration of the run.
      repeats: The number of trainings in each mode; one more is a warm-up.

    Returns:
      The seconds of each training from its first report until its last is written, by mode.
    """
    env = make_jetbot_env(config)
    program = ppo_trainer.CompiledTrainer.from_setup(Setup(config, env=env))
    compiled = program.compile()
    program.compile = lambda: compiled
    seconds: dict[str, list[float]] = {name: [] for name in MODES}
    for repeat in range(repeats + 1):
        for name in seconds:
            duration = _train_once(config, env, program, name)
            if repeat > 0:
                seconds[name].append(duration)
    return seconds


def _train_once(config: Config, env: Any, program: ppo_trainer.CompiledTrainer, mode: str) -> float:
    with tempfile.TemporaryDirectory() as folder, CompileClock() as clock:

        def train(recorder: TrainerCallback) -> _Timed:
            timed = _Timed(recorder)
            ppo_trainer.train(
                program, timed, Preemption(config.preemption_notice), config.checkpoint_interval
            )
            return timed

        if mode == "off":
            timed = train(IntervalTimer(clock))
        else:
            kind = _LogsAndCheckpoints if mode == "saved" else _LogsOnly
            run_dir, setup = Path(folder), Setup(config, env=env)
            parts = composition.Training(
                setup=setup, run_dir=run_dir, run_dirs=[run_dir], ppo=program.ppo
            )
            with (
                mock.patch.object(session, "RunRecorder", kind),
                session.open_recorder(parts, clock, None) as recorder,
            ):
                recorder.begin(MODES[mode])
                timed = train(recorder)
            timed.ended = time.perf_counter()
    return timed.ended - timed.began


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print the cost of each mode.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if logs cost more than `--most`.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--repeats", type=cli.positive_int, default=5)
    parser.add_argument(
        "--most", type=cli.fraction, default=0.02, help="exit code 1 above (default: 0.02)"
    )
    parser.add_argument("--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    config = load_config(options.config, options.overrides)
    seconds = measure(config, options.repeats)
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    costs = {name: median / medians["off"] - 1 for name, median in medians.items()}
    steps = config.ppo.training_steps * config.ppo.steps_per_training_step
    for name, median in medians.items():
        spread = f"{min(seconds[name]):.3f} .. {max(seconds[name]):.3f} s"
        print(f"{MODES[name]:18} {steps / median:12,.0f} steps/s {costs[name]:+8.2%}  ({spread})")
    reports = steps // config.checkpoint_interval
    print(f"a report every {config.checkpoint_interval:,} steps, {medians['off'] / reports:.1f} s")
    if options.output:
        device = jax.devices()[0].device_kind
        write_json(
            options.output, {"device": device, "config": options.config.name, "seconds": seconds}
        )
    return 1 if costs["logs"] > options.most else 0


if __name__ == "__main__":
    cli.run_command(main)
