"""Kill a training repeatedly: `python benchmarks/reliability/torture.py --kills 50`.

One training runs undisturbed. Another one with the same configuration is killed by SIGKILL at
random moments of every phase and restarted with the same command, until it has been killed --kills
times; then it runs to its end. After every kill all checkpoints must be readable, every start must
continue from the newest one, and at the end both trainings must be bit-identical. Both run on the
CPU.
"""

import collections
import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from jetbot_mjx import cli
from jetbot_mjx.agents import TrainState
from jetbot_mjx.config import load_config
from jetbot_mjx.devices import use_compilation_cache
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.checkpoint_store import (
    FOLDER,
    checkpoint_path,
    checkpoint_steps,
    read_about,
    read_tree,
)
from jetbot_mjx.runs.resumption import to_trees
from jetbot_mjx.training.ppo_trainer import CompiledTrainer

CONFIG = CONFIGS / "smoke.yaml"
INTERVAL = 65_536
"""Environment steps between two checkpoints; they take half a second."""
SETTINGS = ("evaluation.episodes=16",)

BEFORE_FIRST = "before the first save"
STARTING = "starting again"
TRAINING = "training"
EVALUATING = "evaluating"
SAVING = "saving"
PHASES = (BEFORE_FIRST, STARTING, TRAINING, EVALUATING, SAVING)

TRAINER = ("-m", "jetbot_mjx.train")
"""The arguments of Python that start the trainer."""

_TIMEOUT = 300.0  # [s]


class RecoveryError(Exception):
    """Raised when a training does not recover from a kill as it should."""


class Process:
    """A training in a process of its own; a context manager that kills it at the end."""

    def __init__(
        self,
        run_dir: Path,
        settings: Sequence[str],
        program: Sequence[str] = TRAINER,
        config: Path = CONFIG,
    ) -> None:
        """Start the process.

        Args:
          run_dir: The run folder; stdout and stderr are written into two files beside it.
          settings: The settings, as for `--set`.
          program: The arguments of Python that start the trainer.
          config: The configuration.
        """
        self.run_dir = run_dir
        self._out, self._err = (run_dir.with_suffix(suffix) for suffix in (".out", ".err"))
        self._left_by_others = _unfinished(run_dir)
        arguments = ["--config", str(config), "--run-dir", str(run_dir)]
        for setting in settings:
            arguments += ["--set", setting]
        with self._out.open("w") as out, self._err.open("w") as err:
            self._process = subprocess.Popen(
                [sys.executable, *program, *arguments],
                stdout=out,
                stderr=err,
                start_new_session=True,
            )

    @property
    def stdout(self) -> str:
        """Return what the process has written to stdout so far."""
        return self._out.read_text(encoding="utf-8")

    @property
    def stderr(self) -> str:
        """Return what the process has written to stderr so far."""
        return self._err.read_text(encoding="utf-8")

    @property
    def seconds_silent(self) -> float:
        """Return the time since the process printed its last line."""
        return time.time() - self._out.stat().st_mtime

    @property
    def unfinished(self) -> set[str]:
        """Return the names of the checkpoints that this process has started and not finished."""
        return _unfinished(self.run_dir) - self._left_by_others

    @property
    def code(self) -> int | None:
        """Return the exit code; None while the process runs."""
        return self._process.poll()

    def send(self, number: int) -> None:
        """Send a signal to the process."""
        self._process.send_signal(number)

    def wait(self) -> int:
        """Wait for the end of the process and return its exit code."""
        return self._process.wait(_TIMEOUT)

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait until a condition is true.

        Raises:
          RecoveryError: The process ended before, or the wait timed out.
        """
        began = time.monotonic()
        while not condition():
            # This process deletes them seconds before it may use the same name again.
            self._left_by_others &= _unfinished(self.run_dir)
            if self.code is not None:
                raise RecoveryError(
                    f"ended too early with {self.code}:\n{self.stdout}{self.stderr}"
                )
            if time.monotonic() - began > _TIMEOUT:
                raise RecoveryError(
                    f"timed out after {_TIMEOUT:.0f} s:\n{self.stdout}{self.stderr}"
                )
            time.sleep(0.001)

    def __enter__(self) -> "Process":
        """Return this process."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Kill the process if it still runs, and all processes that it started."""
        # Orphaned processes, such as one of a library that MuJoCo imports, would write into the
        # files of the next process.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


class Outcome(NamedTuple):
    """An `Outcome` holds results of a training that must not depend on interruptions."""

    fingerprint: str
    """The SHA-256 of the parameters that the training prints at its end."""
    digests: Mapping[str, str]
    """The SHA-256 of each tree of the last checkpoint: the whole training state."""
    progress: Mapping[str, Any]
    """The progress in the last checkpoint, without times."""
    metrics: Sequence[Mapping[str, Any]]
    """The lines of `metrics.jsonl`, without times."""


def finish(
    run_dir: Path,
    settings: Sequence[str],
    program: Sequence[str] = TRAINER,
    config: Path = CONFIG,
) -> Outcome:
    """Run a training to its end, from its newest checkpoint if there is one.

    Args:
      run_dir: The run folder.
      settings: The settings, as for `--set`.
      program: The arguments of Python that start the trainer.
      config: The configuration.

    Returns:
      The outcome of the training.

    Raises:
      RecoveryError: The training failed.
    """
    known = checkpoint_steps(run_dir)
    with Process(run_dir, settings, program, config) as process:
        code = process.wait()
    check_start(process, known)
    if code != 0:
        raise RecoveryError(f"ended with {code}:\n{process.stdout}{process.stderr}")
    about = read_about(checkpoint_path(run_dir, checkpoint_steps(run_dir)[-1]))
    lines = (run_dir / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    return Outcome(
        re.findall(r"sha256 ([0-9a-f]{64})", process.stdout)[0],
        about["sha256"],
        {name: value for name, value in about["progress"].items() if name != "wall_seconds"},
        [
            {
                name: value
                for name, value in json.loads(line).items()
                if name != "timestamp" and not name.startswith("time/")
            }
            for line in lines
        ],
    )


def make_template(settings: Sequence[str], config: Path = CONFIG) -> TrainState:
    """Return the shapes and dtypes of the state that a training with these settings saves."""
    return CompiledTrainer.from_setup(Setup(load_config(config, settings))).template()


def check_checkpoint(run_dir: Path, env_steps: int, template: TrainState) -> None:
    """Read a whole checkpoint; raise CheckpointError if it is not as it was written."""
    for name, tree in jax.eval_shape(to_trees, template).items():
        read_tree(checkpoint_path(run_dir, env_steps), name, tree)


def check_start(process: Process, known: Sequence[int]) -> None:
    """Check that a process continued from the newest checkpoint.

    Args:
      process: A process that has ended.
      known: The environment steps of the checkpoints at its start.

    Raises:
      RecoveryError: The process continued from elsewhere, skipped a checkpoint, or printed a
        traceback.
    """
    printed = process.stdout + process.stderr
    # A training may have come to its end before the kill: the next one finds nothing to do.
    found = re.findall(r"(?:resuming|complete) after ([\d,]+)", printed)
    resumed = [int(steps.replace(",", "")) for steps in found]
    started = "run folder: " in printed or "best policy: " in printed
    wanted = [known[-1]] if known and (started or resumed) else []
    if resumed != wanted or "skipped: " in printed or "Traceback" in printed:
        raise RecoveryError(
            f"found {list(known)}, should continue after {wanted}, and printed:\n{printed}"
        )


class Aim(NamedTuple):
    """An `Aim` holds the moment at which a process is disturbed."""

    event: str
    """The event to wait for: `started`, `trained`, `reported`, `saving` or `saved`."""
    delay: float
    """The time between the event and the moment [s]."""
    count: int = 1
    """The number of occurrences in this process to wait for, for the last three events."""


class Kill(NamedTuple):
    """A `Kill` holds the phase of a kill and the checkpoints after it."""

    phase: str
    known: int
    """The number of checkpoints after the kill."""


def draw_aims(kills: int, rng: random.Random) -> list[Aim]:
    """Draw the moments of the kills, such that all phases occur."""
    early = [
        Aim("started", rng.uniform(0.2, 3.0)),
        Aim("saving", rng.uniform(0.0, 0.05)),
        Aim("started", rng.uniform(2.0, 6.0)),
        Aim("saving", rng.uniform(0.0, 0.1)),
    ]
    kinds = [
        lambda: Aim("started", rng.uniform(0.2, 5.0)),
        lambda: Aim("trained", rng.uniform(0.0, 2.0)),
        lambda: Aim("reported", rng.uniform(0.0, 0.7), rng.randint(1, 3)),
        lambda: Aim("saving", rng.uniform(0.0, 0.1), rng.randint(1, 3)),
        lambda: Aim("saved", rng.uniform(0.0, 0.02), rng.randint(1, 3)),
    ]
    later = [kinds[index % len(kinds)]() for index in range(kills)]
    rng.shuffle(later)
    return [*early, *later][:kills]


def kill(
    run_dir: Path,
    settings: Sequence[str],
    aim: Aim,
    template: TrainState,
    program: Sequence[str] = TRAINER,
    config: Path = CONFIG,
) -> Kill:
    """Start a training, kill it, and check its checkpoints.

    Args:
      run_dir: The run folder.
      settings: The settings, as for `--set`.
      aim: The moment of the kill.
      template: The shapes and dtypes of a state.
      program: The arguments of Python that start the trainer.
      config: The configuration.

    Returns:
      The phase in which the process was killed.

    Raises:
      RecoveryError: The process ended by itself, or did not continue from the newest checkpoint.
      CheckpointError: A checkpoint is damaged.
    """
    # Kill the process at its moment.
    known = checkpoint_steps(run_dir)
    with Process(run_dir, settings, program, config) as process:
        reach(process, known, aim)
        printed, silence = process.stdout, process.seconds_silent
    # Check where it started from and what it left.
    check_start(process, known)
    left = checkpoint_steps(run_dir)
    for steps in left:
        check_checkpoint(run_dir, steps, template)
    # Infer the phase in which it was killed.
    if process.unfinished:
        phase = SAVING
    elif not left:
        phase = BEFORE_FIRST
    else:
        phase = _phase(printed, silence)
    return Kill(phase, len(left))


def reach(process: Process, known: Sequence[int], aim: Aim) -> None:
    """Wait for a moment of a process.

    Args:
      process: The process.
      known: The environment steps of the checkpoints at its start.
      aim: The moment.

    Raises:
      RecoveryError: The process ended before, or the wait timed out.
    """
    process.until(_condition(process, known, aim))
    moment = time.monotonic() + aim.delay
    process.until(lambda: time.monotonic() > moment)


def _condition(process: Process, known: Sequence[int], aim: Aim) -> Callable[[], bool]:
    seen: set[str] = set()

    def saving() -> bool:
        seen.update(process.unfinished)
        return len(seen) >= aim.count

    conditions = {
        "started": lambda: True,
        "trained": lambda: "first training step done" in process.stdout,
        "reported": lambda: len(_reports(process.stdout)) >= aim.count,
        "saving": saving,
        "saved": lambda: (
            sum(x not in known for x in checkpoint_steps(process.run_dir)) >= aim.count
        ),
    }
    return conditions[aim.event]


def _phase(printed: str, silence: float) -> str:
    """Return the phase of a process that was not saving, inferred from its output.

    Args:
      printed: The output until the kill.
      silence: The time between its last line and the kill [s].
    """
    if "first training step done" not in printed:
        return STARTING
    rates = [rate for line in _reports(printed) for rate in re.findall(r"([\d,]+) steps/s", line)]
    rate = float(rates[-1].replace(",", "")) if rates else 40_000.0
    last_is_report = " steps  success" in printed.splitlines()[-1]
    steps = INTERVAL if last_is_report else INTERVAL / 2
    return TRAINING if silence < steps / rate else EVALUATING


def _reports(printed: str) -> list[str]:
    return [line for line in printed.splitlines() if " steps  success" in line]


def _unfinished(run_dir: Path) -> set[str]:
    folder = run_dir / FOLDER
    if not folder.is_dir():
        return set()
    return {path.name for path in folder.iterdir() if path.name.endswith(".unfinished")}


def table(kills: Sequence[Kill]) -> str:
    """Return a table of the number of kills in each phase."""
    count = collections.Counter(one.phase for one in kills)
    rows = [f"| {phase:<24} | {count[phase]:>5} |" for phase in PHASES]
    return "\n".join(
        ["| phase                    | kills |", "|:-------------------------|------:|", *rows]
    )


def differences(one: Outcome, other: Outcome) -> list[str]:
    """Return the names of the fields that differ."""
    return [name for name in Outcome._fields if getattr(one, name) != getattr(other, name)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill the training repeatedly, print the table and the verdict.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if the training did not recover.
    """
    # Both trainings run on the CPU, with settings that make checkpoints frequent.
    parser = cli.Parser(description=__doc__)
    parser.add_argument(
        "--kills", type=cli.positive_int, default=50, help="number of kills (default: 50)"
    )
    parser.add_argument(
        "--config", type=Path, default=CONFIG, help="configuration (default: configs/smoke.yaml)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments (default: 0)")
    options = parser.parse_args(arguments)
    jax.config.update("jax_platforms", "cpu")
    os.environ["JAX_PLATFORMS"] = "cpu"
    use_compilation_cache()
    timesteps = INTERVAL * (8 + 3 * options.kills)
    settings = [*SETTINGS, f"checkpoint_interval={INTERVAL}", "checkpoints_to_keep=4"]
    settings += [f"ppo.num_timesteps={timesteps}"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        began = time.monotonic()
        # The reference runs undisturbed.
        undisturbed = finish(folder / "undisturbed", settings, config=options.config)
        print(f"undisturbed: {timesteps:,} steps, {time.monotonic() - began:.0f} s", flush=True)
        # The other is killed and restarted, and must end equal.
        kills: list[Kill] = []
        try:
            template = make_template(settings, options.config)
            for aim in draw_aims(options.kills, random.Random(options.seed)):
                run_dir = folder / "killed"
                kills.append(kill(run_dir, settings, aim, template, config=options.config))
                print(
                    f"{len(kills):>4}  {aim.event} + {aim.delay:.3f} s: {kills[-1].phase},"
                    f" {kills[-1].known} checkpoints, {time.monotonic() - began:.0f} s",
                    flush=True,
                )
            killed = finish(folder / "killed", settings, config=options.config)
            found = differences(undisturbed, killed)
            verdict = f"different at the end: {', '.join(found)}" if found else ""
        except (RecoveryError, UserError) as error:
            verdict = str(error)
    print(table(kills))
    print(
        f"{len(kills)} kills in {time.monotonic() - began:.0f} s: "
        + (
            verdict
            or "all checkpoints readable, all starts from the newest, bit-identical at the end"
        )
    )
    return 1 if verdict else 0


if __name__ == "__main__":
    cli.run_command(main)
