"""Train for long and see what grows: `python benchmarks/reliability/soak.py --seconds 3600`.

One process trains. At the end of every interval it notes its memory, open files, threads, the
memory of its device, what its logs grew by, the rate of steps, and the processor time they took. A
line is fitted to each of them: one drifts if its slope is larger than three times its standard
error, and makes it worse by more than a hundredth over the whole time, files and threads also by
more than one. Less memory is not worse. With `--kills`, other trainings are killed at random
moments and resumed until they end as one that was never disturbed, again and again until there were
so many kills, five of six by SIGKILL and one by SIGTERM. `--jobs` of them run at a time.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.results import check_output, write
from benchmarks.reliability.torture import Process, RecoveryError, finish
from jetbot_mjx import cli
from jetbot_mjx.config import Config, find_config, load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import theme, to_png
from jetbot_mjx.runs import write_bytes
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps
from jetbot_mjx.runs.metrics import METRICS
from jetbot_mjx.runs.run_dir import versions
from jetbot_mjx.training import session
from jetbot_mjx.training.callbacks import Progress
from jetbot_mjx.training.run_recorder import RunRecorder

_WARM_UP = 0.25
"""Part of the intervals, from the first on, in which caches fill and that no line is fitted to."""
_LEAST_SAMPLES = 6
_LARGEST_CHANGE = 0.01
"""Change over the whole time, relative to the mean, that is no drift."""
_COUNTS = ("files", "threads")
_ONE_MORE = 1.5
"""What the line of a count changes by at most if one came or went, when it is in the middle."""
_CERTAIN = 3.0
"""Standard errors that a slope has at least if it is one."""

QUANTITIES = {
    "memory": "resident memory [bytes]",
    "files": "open files",
    "threads": "threads",
    "device_memory": "memory of the device [bytes]",
    "log": "growth of the logs [bytes]",
    "rate": "steps per second of training",
    "work": "processor time of a million steps [s]",
}


class Sample(NamedTuple):
    """A `Sample` holds what a process has and did at the end of an interval."""

    env_steps: int
    seconds: float
    """Since the first sample."""
    memory: float
    files: float
    threads: float
    device_memory: float
    """0 where the device does not tell it."""
    log: float
    """What the logs grew by in this interval."""
    rate: float
    work: float
    """What all threads took; other programs move it less than the rate."""


class Slope(NamedTuple):
    """A `Slope` holds the line that was fitted to a quantity."""

    quantity: str
    mean: float
    slope: float
    """Change of an interval."""
    error: float
    """Standard error of the slope."""
    drifts: bool


def fit(quantity: str, values: Sequence[float]) -> Slope:
    """Fit a line to the values of all intervals, and say whether it drifts.

    Args:
      quantity: one of `QUANTITIES`.
      values: the values; those of the warm-up are left out.

    Raises:
      UserError: there are too few.
    """
    used = np.asarray(values[int(_WARM_UP * len(values)) :], float)
    if len(used) < _LEAST_SAMPLES:
        raise UserError(
            f"{len(values)} intervals are too few to fit a line: train for longer, or with a"
            " shorter checkpoint_interval"
        )
    at = np.arange(len(used)) - (len(used) - 1) / 2
    mean, slope = float(used.mean()), float(at @ used / (at @ at))
    rest = used - mean - slope * at
    error = float(np.sqrt(rest @ rest / (len(used) - 2) / (at @ at)))
    worse = -slope if quantity == "rate" else slope
    is_certain = worse > _CERTAIN * error
    least = max(_LARGEST_CHANGE * abs(mean), _ONE_MORE * (quantity in _COUNTS))
    return Slope(quantity, mean, slope, error, bool(is_certain and worse * len(used) > least))


def watch(config: Config, run_dir: Path, seconds: float) -> list[Sample]:
    """Train until the configuration's end or for so long, and return what was seen.

    Args:
      config: the configuration.
      run_dir: the run folder, a new one or that of a run that is continued.
      seconds: after this time the training ends with the interval [s].
    """
    samples: list[Sample] = []
    began, size, steps = time.perf_counter(), _size_of_logs(run_dir), 0
    worked = time.process_time()

    class Recorder(RunRecorder):
        """A recorder that notes what the process has."""

        def on_interval(self, progress: Sequence[Progress]) -> bool:
            nonlocal size, steps, worked
            goes_on = super().on_interval(progress)
            one, earlier, before = progress[0], size, worked
            size, made, steps = _size_of_logs(run_dir), one.env_steps - steps, one.env_steps
            now, worked = time.perf_counter() - began, time.process_time()
            if one.seconds > 0:
                rate, work = made / one.seconds, 1e6 * (worked - before) / made
                grown = float(size - earlier)
                samples.append(Sample(steps, now, *_process(), grown, rate, work))
            return goes_on and now < seconds

    with mock.patch.object(session, "RunRecorder", Recorder):
        session.run(config, run_dir)
    return samples


def _process() -> tuple[float, float, float, float]:
    """Return resident memory, open files, threads and the device's memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    stats = jax.local_devices()[0].memory_stats() or {}
    return (
        float(pages * os.sysconf("SC_PAGE_SIZE")),
        float(len(os.listdir("/proc/self/fd"))),
        float(len(os.listdir("/proc/self/task"))),
        float(stats.get("bytes_in_use", 0)),
    )


def _size_of_logs(run_dir: Path) -> int:
    files = [run_dir / METRICS, *run_dir.glob("tensorboard/*"), *run_dir.glob("*.log")]
    return sum(file.stat().st_size for file in files if file.is_file())


class Kills(NamedTuple):
    """A `Kills` holds how often a training was killed, and what became of it."""

    killed: int = 0
    terminated: int = 0
    ended: int = 0
    """Trainings that came to their end, each bit-identical to the one that was not disturbed."""
    resumed: int = 0
    """Kills that left a checkpoint to go on from."""

    def __add__(self, other: tuple[int, ...]) -> "Kills":
        """Return the sums."""
        return Kills(*map(sum, zip(self, other, strict=True)))


def kill_often(
    config: Path,
    settings: Sequence[str],
    folder: Path,
    kills: int,
    *,
    jobs: int = 1,
    seed: int = 0,
) -> Kills:
    """Kill trainings at random moments and resume them until there were enough kills.

    Args:
      config: the configuration file.
      settings: settings, as for `--set`.
      folder: an empty folder.
      kills: number of kills, at least; every sixth is by SIGTERM and the others by SIGKILL.
      jobs: number of trainings at a time.
      seed: the seed of the moments.

    Raises:
      RecoveryError: a training did not resume, or did not end as the one that was not disturbed.
    """
    with Process(folder / "undisturbed", settings, config=config) as process:
        _wait_for_first_line(process)
        began = time.monotonic()
        process.wait()
    longest = time.monotonic() - began
    wanted = finish(folder / "undisturbed", settings, config=config)
    numbers = iter(range(kills))  # of the kills; its `next` is one operation of Python

    def one_job(job: int) -> Kills:
        rng, run_dir, done = random.Random(f"{seed} {job}"), folder / f"killed-{job}", Kills()
        for number in numbers:
            sent = signal.SIGTERM if number % 6 == 5 else signal.SIGKILL
            _kill_once(run_dir, settings, config, sent, rng.uniform(0.0, longest))
            counted = (int(sent == each) for each in (signal.SIGKILL, signal.SIGTERM))
            done += Kills(*counted, resumed=int(bool(checkpoint_steps(run_dir))))
            # Now and then to the end, so that many are compared.
            if rng.random() < 0.2:
                done += end(run_dir)
        return done + end(run_dir)

    def end(run_dir: Path) -> Kills:
        if not run_dir.exists():
            return Kills()
        if finish(run_dir, settings, config=config) != wanted:
            raise RecoveryError(f"{run_dir} ended otherwise than {folder / 'undisturbed'}")
        shutil.rmtree(run_dir)
        return Kills(ended=1)

    with ThreadPoolExecutor(jobs) as threads:
        return sum(threads.map(one_job, range(jobs)), Kills())


def _wait_for_first_line(process: Process) -> None:
    """Wait until a training says something; before, it imports, and writes nothing."""
    while not process.stdout and process.code is None:
        time.sleep(0.01)


def _kill_once(
    run_dir: Path, settings: Sequence[str], config: Path, number: signal.Signals, seconds: float
) -> None:
    """Start or resume a training, and end it by a signal so many seconds after its first line."""
    with Process(run_dir, settings, config=config) as process:
        _wait_for_first_line(process)
        time.sleep(seconds)
        process.send(number)
        process.wait()
    if "Traceback" in process.stderr:
        raise RecoveryError(f"after {number.name} it printed:\n{process.stderr}")


def plot(samples: Sequence[Sample], slopes: Sequence[Slope]) -> Figure:
    """Plot every quantity over the time, and the line that was fitted to it."""
    figure = Figure(figsize=(9, 9), layout="constrained")
    every = figure.subplots(4, 2).ravel()
    hours = np.array([one.seconds for one in samples]) / 3600
    for axes, slope in zip(every, slopes, strict=False):
        values = np.array([getattr(one, slope.quantity) for one in samples])
        first = int(_WARM_UP * len(samples))
        at = np.arange(len(samples) - first) - (len(samples) - first - 1) / 2
        axes.plot(hours, values, ".", markersize=3)
        axes.plot(hours[first:], slope.mean + slope.slope * at, color="C1")
        title = QUANTITIES[slope.quantity] + (": drifts" if slope.drifts else "")
        axes.set(title=title, xlabel="time [h]", ylim=(0, 1.1 * max(values.max(), 1)))
        axes.grid(visible=True)
    for axes in every[len(slopes) :]:
        axes.remove()
    return figure


def _table(slopes: Sequence[Slope]) -> str:
    lines = [f"{'':40}{'mean':>16}{'an interval':>16}{'error':>14}"]
    for one in slopes:
        numbers = f"{one.mean:16,.1f}{one.slope:+16,.2f}{one.error:14,.2f}"
        lines.append(f"{QUANTITIES[one.quantity]:40}{numbers}{'  drifts' * one.drifts}")
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", default="smoke", help="configuration (default: smoke)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--run-dir", type=Path, help="run folder (default: one that is removed)")
    parser.add_argument("--seconds", type=float, default=600, help="longest time (default: 600)")
    parser.add_argument("--kills", type=int, default=0, help="number of kills (default: 0)")
    parser.add_argument(
        "--jobs", type=cli.positive_int, default=1, help="trainings that are killed at a time"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments of the kills")
    parser.add_argument("--output", type=Path, help="JSON file; a plot is written beside it")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, print what drifts, and write the JSON file and the plot.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if something drifts or a killed training did not recover.
    """
    options = _parser().parse_args(arguments)
    if options.output:
        check_output(options.output)
    # A run of the configuration's own length would end after seconds.
    longest = [] if any("num_timesteps" in x for x in options.overrides) else ["1e11"]
    settings = [*options.overrides, *(f"ppo.num_timesteps={one}" for one in longest)]
    config = load_config(options.config, settings)
    values: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as place:
        samples = watch(config, options.run_dir or Path(place) / "run", options.seconds)
        slopes = [fit(name, [getattr(one, name) for one in samples]) for name in QUANTITIES]
        print(f"{len(samples)} intervals, {samples[-1].env_steps:,} steps")
        print(_table(slopes))
        if options.kills:
            values["kills"] = _kill(options, Path(place))
    values |= _as_json(config, samples, slopes)
    if options.output:
        write(options.output, values)
        with theme("light"):
            write_bytes(options.output.with_suffix(".png"), to_png(plot(samples, slopes)))
    is_lost = "failure" in values.get("kills", {})
    return int(is_lost or any(one.drifts for one in slopes))


def _kill(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Kill a training as often as asked for; return what became of it as JSON."""
    file = find_config(options.config)
    kills, jobs, seed = options.kills, options.jobs, options.seed
    try:
        done = kill_often(file, options.overrides, folder, kills, jobs=jobs, seed=seed)
    except RecoveryError as error:
        print(f"a killed training did not recover: {error}")
        return {"failure": str(error)}
    print(
        f"killed {done.killed} times, terminated {done.terminated} times, {done.resumed} of them"
        f" after a checkpoint: {done.ended} trainings ended bit-identical"
    )
    return done._asdict()


def _as_json(
    config: Config, samples: Sequence[Sample], slopes: Sequence[Slope]
) -> Mapping[str, Any]:
    return {
        "device": jax.devices()[0].device_kind,
        "versions": versions(),
        "config": config.model_dump(mode="json"),
        "slopes": [one._asdict() for one in slopes],
        "samples": [one._asdict() for one in samples],
    }


if __name__ == "__main__":
    cli.run_command(main)
