"""Train on a drive that answers late or fails: `python benchmarks/reliability/network_drive.py`.

The run folder is a drive whose calls are late, are interrupted, or fail, now and then or all from a
moment on, as those of a network drive do. Each training is killed, or ends by itself where the
drive fails, and is given the same command again, until it is complete. Late calls must change
nothing. A call that fails must cost one line and no checkpoint; so may one that is interrupted
while TensorStore reads, which does not repeat it as Python does. All must end with the same bits as
a training on a drive without faults. It needs FUSE, libfuse and mfusepy.
"""

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.faulty_drive import FaultyDrive, why_not
from benchmarks.harness.results import check_output, write
from benchmarks.reliability import torture
from benchmarks.reliability.torture import Aim, Outcome, Process, RecoveryError
from jetbot_mjx import cli
from jetbot_mjx.agents import TrainState
from jetbot_mjx.devices import use_compilation_cache
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps
from jetbot_mjx.runs.run_dir import versions

SETTINGS = (*torture.SETTINGS, "checkpoint_interval=8_192", "ppo.num_timesteps=131_072")

ERRORS = ("EIO", "ETIMEDOUT", "ESTALE", "ENOTCONN")
"""What network drives answer while they do not work."""

_MOST_STARTS = 30


class Ground(NamedTuple):
    """A `Ground` holds what all trainings share."""

    settings: Sequence[str]
    program: Sequence[str]
    template: TrainState
    undisturbed: Outcome


class Trial:
    """A `Trial` starts one training on one drive, again and again."""

    def __init__(self, drive: FaultyDrive, ground: Ground, rng: random.Random) -> None:
        """Begin with an empty drive."""
        self.drive, self.ground, self.rng = drive, ground, rng
        self.starts = 0
        self.lines: list[str] = []
        """The errors of the processes that failed."""

    def fail(self, aim: Aim | None, error: str, share: float) -> bool:
        """Start the training, and let the drive fail until the process has ended.

        Args:
          aim: when the drive begins to fail; None: at once.
          error: the name of the error.
          share: the share of the calls that fail.

        Returns:
          Whether the training came to its end all the same.

        Raises:
          RecoveryError: it printed something else than one line, or continued from elsewhere.
          CheckpointError: a checkpoint was lost.
        """
        self.starts += 1
        drive = self.drive
        known = checkpoint_steps(drive.folder)
        with Process(drive.mount, self.ground.settings, self.ground.program) as process:
            if aim:
                torture.reach(process, known, aim)
            confirmed = checkpoint_steps(drive.folder)
            drive.set(share, error)
            code = process.wait()
        drive.set()
        torture.check_start(process, known)
        left = checkpoint_steps(drive.folder)
        if not {*known, *confirmed} <= {*left}:
            raise RecoveryError(f"of the checkpoints {confirmed} only {left} are left")
        for steps in left:
            torture.check_checkpoint(drive.folder, steps, self.ground.template)
        if code == 0:
            return True
        lines = process.stderr.splitlines()
        if code != cli.USER_ERROR or len(lines) != 1 or not lines[0].startswith("error: "):
            raise RecoveryError(f"ended with {code}:\n{process.stdout}{process.stderr}")
        self.lines.append(lines[0].replace(str(drive.mount), "DRIVE"))
        return False

    def kill(self, aim: Aim) -> None:
        """Start the training and kill it at a moment."""
        self.starts += 1
        ground = self.ground
        torture.kill(self.drive.mount, ground.settings, aim, ground.template, ground.program)

    def finish(self) -> None:
        """Start the training for the last time, and compare its end.

        Raises:
          RecoveryError: it failed, or has other bits.
        """
        self.starts += 1
        ground = self.ground
        ended = torture.finish(self.drive.mount, ground.settings, ground.program)
        if found := torture.differences(ground.undisturbed, ended):
            raise RecoveryError(f"different at the end: {', '.join(found)}")


def _kill_twice(trial: Trial) -> None:
    trial.kill(Aim("saving", trial.rng.uniform(0.0, 0.1), 2))
    trial.kill(Aim("saved", trial.rng.uniform(0.0, 1.0), 3))
    trial.finish()


def late(trial: Trial) -> None:
    """Kill a training on a drive that is late, and let it end there."""
    trial.drive.set(0.03, seconds=(0.02, 0.2))
    _kill_twice(trial)


def interrupted(trial: Trial) -> None:
    """Start a training on a drive of which a call may be interrupted, ever less often."""
    for start in range(_MOST_STARTS):
        if trial.fail(None, "EINTR", 0.1 * 0.6**start):
            break
    trial.finish()


def now_and_then(trial: Trial) -> None:
    """Start a training on a drive of which each call may fail, ever less often."""
    for start in range(_MOST_STARTS):
        if trial.fail(None, trial.rng.choice(ERRORS), 0.01 * 0.8**start):
            break
    trial.finish()


def outage(trial: Trial) -> None:
    """Let the drive fail from a moment on, and give the same command once it answers."""
    rng = trial.rng
    aims = [Aim("started", rng.uniform(0.5, 5.0)) for _ in range(2)]
    aims += [Aim("saving", rng.uniform(0.0, 0.05), count) for count in (1, 2)]
    aims += [Aim("saved", rng.uniform(0.0, 0.3), count) for count in (1, 2)]
    rng.shuffle(aims)
    for number, aim in enumerate(aims):
        trial.fail(aim, ERRORS[number % len(ERRORS)], 1.0)
    trial.finish()


SCENARIOS: dict[str, Callable[[Trial], None]] = {
    "late": late,
    "interrupted": interrupted,
    "now and then": now_and_then,
    "outage": outage,
}


class Row(NamedTuple):
    """A `Row` holds what became of a training."""

    drive: str
    starts: int
    """Processes until the training was complete."""
    calls: int
    faults: int
    lines: Sequence[str]
    """The error that ended each process that failed."""
    wrong: str
    """What was not as it should be."""


def train_on(name: str, folder: Path, ground: Ground, seed: int = 0) -> Row:
    """Train on one kind of drive.

    Args:
      name: the name of the scenario.
      folder: an empty folder.
      ground: what all trainings share.
      seed: seed of the moments.

    Raises:
      UserError: the drive cannot be mounted.
    """
    files, mount = folder / "files", folder / "drive"
    files.mkdir()
    mount.mkdir()
    with FaultyDrive(files, mount) as drive:
        trial, wrong = Trial(drive, ground, random.Random(seed)), ""
        try:
            SCENARIOS[name](trial)
        except (RecoveryError, UserError, OSError, subprocess.TimeoutExpired) as error:
            wrong = str(error)
        return Row(name, trial.starts, **drive.set(), lines=trial.lines, wrong=wrong)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train on all kinds of drives, print a table and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if a training lost something or ended otherwise.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--drives", nargs="+", choices=SCENARIOS, default=list(SCENARIOS))
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments (default: 0)")
    parser.add_argument("--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    if reason := why_not():
        print(f"no drive can be mounted: {reason}")
        return 0
    if options.output:
        check_output(options.output)
    jax.config.update("jax_platforms", "cpu")
    os.environ["JAX_PLATFORMS"] = "cpu"
    use_compilation_cache()
    rows = []
    with tempfile.TemporaryDirectory() as name:
        undisturbed = torture.finish(Path(name, "undisturbed"), SETTINGS)
        template = torture.make_template(SETTINGS)
        ground = Ground(SETTINGS, torture.TRAINER, template, undisturbed)
        print(f"{'drive':14}{'starts':>7}{'calls':>8}{'faults':>8}{'errors':>8}{'[s]':>6}")
        for drive in options.drives:
            began, folder = time.monotonic(), Path(name, drive)
            folder.mkdir()
            rows.append(row := train_on(drive, folder, ground, options.seed))
            numbers = f"{row.starts:7}{row.calls:8,}{row.faults:8,}{len(row.lines):8}"
            print(f"{drive:14}{numbers}{time.monotonic() - began:6.0f}  {row.wrong}", flush=True)
    if options.output:
        results = [row._asdict() for row in rows]
        write(options.output, {"seed": options.seed, "versions": versions(), "rows": results})
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    cli.run_command(main)
