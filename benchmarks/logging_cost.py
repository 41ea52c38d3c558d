"""Measures what logging and saving cost: `python benchmarks/logging_cost.py --config FILE`.

The same compiled training runs again and again, in turn with nobody listening; with what
`python -m jetbot_mjx.train` logs at a report: metrics.jsonl, TensorBoard, the terminal (on one, the
dashboard too); and with the whole state saved to disk in the background as well. Evaluations are
left out of all: they are no logging.
"""

import statistics
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import jax
from measurements import Listener

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import ProgramCache
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.runs.metrics import CompileClock
from jetbot_mjx.runs.run_dir import write_json
from jetbot_mjx.training import ppo_trainer, session
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.preemption import Preemption
from jetbot_mjx.training.run_recorder import RunRecorder, SeedRecorder

_UNJUDGED = Summary(1, 0, 0.0, 0.0, 1.0, None, None, None, 0.0, 1.0, 0)


WAYS = {"off": "nobody listens", "logs": "logs", "saved": "logs, checkpoints"}


class _Timed(TrainerCallback):
    """Passes reports on, and notes when they have been dealt with."""

    def __init__(self, recorder: TrainerCallback) -> None:
        self._recorder = recorder
        self.began = self.ended = 0.0

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        going_on = self._recorder.on_interval(progress)
        # From the end of the first report: what compiles comes before it.
        self.ended = time.perf_counter()
        self.began = self.began or self.ended
        return going_on

    def on_progress(self, env_steps: int, metrics: Mapping[str, float], seconds: float) -> None:
        self._recorder.on_progress(env_steps, metrics, seconds)


class _NotEvaluated(RunRecorder):
    def __init__(self, seeds: Sequence[SeedRecorder], *arguments: Any, **options: Any) -> None:
        super().__init__(seeds, *arguments, **options)
        self._evaluate = lambda params: _UNJUDGED


def _save_nothing(progress: Progress, evaluation: Mapping[str, Any], wall_seconds: float) -> None:
    del progress, evaluation, wall_seconds


class _Unsaved(_NotEvaluated):
    def __init__(self, seeds: Sequence[SeedRecorder], *arguments: Any, **options: Any) -> None:
        super().__init__(seeds, *arguments, **options)
        for seed in seeds:
            seed.save = _save_nothing


def measure(config: Config, repeats: int) -> dict[str, list[float]]:
    """Times all `WAYS`.

    Args:
      config: the run.
      repeats: trainings of each.

    Returns:
      Seconds of every training from its first report to its last, all of that on disk.
    """
    env = make_env(config)
    program = ppo_trainer.CompiledTrainer.from_config(config, env)
    compiled = program.compile()
    program.compile = lambda: compiled
    seconds: dict[str, list[float]] = {name: [] for name in WAYS}
    for repeat in range(repeats + 1):
        for name in seconds:
            lasted = _once(config, env, program, name)
            if repeat > 0:
                seconds[name].append(lasted)
    return seconds


def _once(config: Config, env: Any, program: ppo_trainer.CompiledTrainer, way: str) -> float:
    with tempfile.TemporaryDirectory() as folder, CompileClock() as clock:

        def train(recorder: TrainerCallback) -> _Timed:
            timed = _Timed(recorder)
            ppo_trainer.train(
                program, timed, Preemption(config.preemption_notice), config.checkpoint_interval
            )
            return timed

        if way == "off":
            timed = train(Listener(clock))
        else:
            kind = _NotEvaluated if way == "saved" else _Unsaved
            run_dir, programs = Path(folder), ProgramCache(compiler_options(config))
            parts = session.Training(config, run_dir, [run_dir], env, program.ppo, programs)
            with (
                mock.patch.object(session, "RunRecorder", kind),
                session.open_recorder(parts, clock, None) as recorder,
            ):
                recorder.begin(WAYS[way])
                timed = train(recorder)
            timed.ended = time.perf_counter()
    return timed.ended - timed.began


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, measures and prints.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 1 where logs cost more than `--most`.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--repeats", type=cli.positive_int, default=5)
    parser.add_argument("--most", type=cli.fraction, default=0.02, help="default: 0.02")
    parser.add_argument("--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    config = load_config(options.config, options.overrides)
    seconds = measure(config, options.repeats)
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    costs = {name: median / medians["off"] - 1 for name, median in medians.items()}
    steps = config.ppo.training_steps * config.ppo.steps_per_training_step
    for name, median in medians.items():
        spread = f"{min(seconds[name]):.3f} .. {max(seconds[name]):.3f} s"
        print(f"{WAYS[name]:18} {steps / median:12,.0f} steps/s {costs[name]:+8.2%}  ({spread})")
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
