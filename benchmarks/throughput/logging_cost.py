"""Measure the cost of logs and checkpoints.

    python benchmarks/throughput/logging_cost.py --config configs/jetbot.yaml

A training tells how long an interval takes. Its last state is then reported again and again,
without training between two reports, in three modes: with the logs of `jetbot-mjx train`
(metrics.jsonl, TensorBoard, the terminal and its dashboard); with a checkpoint as well, which is
saved in the background; and the same without the syncs that keep it through a power cut. Between
two reports the process sleeps for as long as the interval, at most `--pause`. No mode runs
evaluations.

Each report costs the time that the training waits for it, and processor time of other threads. At
most, a training on all of the processors loses the first and, spread over the processors, the
second: their sum, divided by the interval, is `at most`. A training on a GPU loses only the first.
Training with and without reports and timing both says less: from one minute to the next such times
differ by ten times the cost.
"""

import contextlib
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_jetbot_env
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.runs import Setup, durable
from jetbot_mjx.runs.metrics import CompileClock
from jetbot_mjx.runs.run_dir import write_json
from jetbot_mjx.training import composition, ppo_trainer, session
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.preemption import Preemption
from jetbot_mjx.training.run_recorder import RunRecorder

_NO_EVALUATION = Summary(1, 0, 0.0, 0.0, 1.0, None, None, None, 0.0, 1.0, 0)

MODES = {
    "logs": "logs",
    "saved": "logs, checkpoints",
    "unsynced": "logs, checkpoints without syncs",
}
"""The description of each mode, by its name."""


class Cost(NamedTuple):
    """A `Cost` is that of one report."""

    waiting: float
    """Time that the training waits [s]."""
    background: float
    """Processor time of all other threads, until the next report [s]."""

    def most(self, interval: float, processors: int) -> float:
        """Return the largest part of its speed that a training can lose."""
        return (self.waiting + self.background / processors) / interval


class _Interval(TrainerCallback):
    """A callback that keeps the last state, and the seconds of all intervals."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.last: Progress | None = None

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        self.seconds.append(progress[0].seconds)
        self.last = progress[0]
        return True


class _LogsAndCheckpoints(RunRecorder):
    """A recorder that runs no evaluations."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.evaluate = lambda params: _NO_EVALUATION


class _LogsOnly(_LogsAndCheckpoints):
    """A recorder that runs no evaluations and saves no checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for seed in self.seeds:
            seed.save = lambda *_, **__: None


def measure(
    config: Config, reports: int, pause: float
) -> tuple[float, Mapping[str, Sequence[Cost]]]:
    """Measure what a report costs in each mode.

    Args:
      config: the configuration of the run.
      reports: number of reports in each mode; the first ones, which open files, are extra.
      pause: longest pause after each of them [s].

    Returns:
      The median of the intervals of training [s], and the cost of each report by mode.
    """
    env = make_jetbot_env(config)
    program = ppo_trainer.CompiledTrainer.from_setup(Setup(config, env=env))
    trained = _Interval()
    ppo_trainer.train(
        program, trained, Preemption(config.preemption_notice), config.checkpoint_interval
    )
    assert trained.last is not None
    interval = statistics.median(trained.seconds[1:])
    costs: dict[str, list[Cost]] = {mode: [] for mode in MODES}
    # In turns, so that a busy minute of the machine is spread over all modes.
    for _ in range(5):
        for mode, those in costs.items():
            with _recorder(config, program, env, mode) as recorder:
                counted = _report(
                    recorder, trained.last, max(1, reports // 5), min(interval, pause)
                )
            those.extend(counted)
    return interval, costs


@contextlib.contextmanager
def _recorder(
    config: Config, program: ppo_trainer.CompiledTrainer, env: JetBotEnv, mode: str
) -> Iterator[RunRecorder]:
    """Open the recorder of a mode, for a run in a folder that is deleted afterwards."""
    kind = _LogsOnly if mode == "logs" else _LogsAndCheckpoints
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        clock = stack.enter_context(CompileClock())
        stack.enter_context(mock.patch.object(session, "RunRecorder", kind))
        if mode == "unsynced":
            stack.enter_context(mock.patch.object(durable.os, "fsync", return_value=None))
        parts = composition.Training(
            setup=Setup(config, env=env), run_dir=folder, run_dirs=[folder], ppo=program.ppo
        )
        recorder = stack.enter_context(session.open_recorder(parts, clock, None))
        recorder.begin(MODES[mode])
        yield recorder


def _report(recorder: RunRecorder, last: Progress, reports: int, pause: float) -> list[Cost]:
    """Report the same state again and again, and return what each report but the first two cost."""
    costs = []
    for number in range(reports + 2):
        progress = last._replace(env_steps=last.env_steps + number)
        began, used = time.perf_counter(), time.process_time() - time.thread_time()
        recorder.on_interval([progress])
        waited = time.perf_counter() - began
        time.sleep(pause)
        costs.append(Cost(waited, time.process_time() - time.thread_time() - used))
    return costs[2:]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print the cost of each mode.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if the syncs of a checkpoint cost more than `--most`.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--reports", type=cli.positive_int, default=100, help="(default: 100)")
    parser.add_argument("--pause", type=float, default=0.5, help="[s] (default: 0.5)")
    parser.add_argument(
        "--most", type=cli.fraction, default=0.01, help="exit code 1 above (default: 0.01)"
    )
    parser.add_argument("--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    config = load_config(options.config, options.overrides)
    interval, costs = measure(config, options.reports, options.pause)
    device = jax.devices()[0]
    processors = len(os.sched_getaffinity(0)) if device.platform == "cpu" else None
    most = {}
    print(f"\nan interval of {config.checkpoint_interval:,} steps takes {interval:.3f} s")
    for mode, those in costs.items():
        median = Cost(*(statistics.median(values) for values in zip(*those, strict=True)))
        if processors is None:
            most[mode] = median.waiting / interval
        else:
            most[mode] = median.most(interval, processors)
        print(
            f"{MODES[mode]:32} waiting {1e3 * median.waiting:6.2f} ms,"
            f" background {1e3 * median.background:6.2f} ms: at most {most[mode]:.2%}"
        )
    if options.output:
        conditions = {"device": device.device_kind, "config": options.config.name}
        conditions |= {"interval": interval, "processors": processors, "most": most}
        seconds = {mode: list(zip(*those, strict=True)) for mode, those in costs.items()}
        write_json(options.output, {**conditions, "waiting_and_background": seconds})
    return 1 if most["saved"] - most["unsynced"] > options.most else 0


if __name__ == "__main__":
    cli.run_command(main)
