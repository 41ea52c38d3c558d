"""Kills a training again and again: `python benchmarks/torture.py --kills 50`.

One training runs undisturbed. Another of the same configuration is ended by SIGKILL at random
moments of every phase, and the same command is given again, until it has been killed that often
and may finish. After every kill all checkpoints must be whole, every start must go on from the
newest, and at the end not a bit may differ between the two. On the CPU.
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

from jetbot_mjx import cli
from jetbot_mjx.agents.ppo import TrainState
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.config import load_config
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint_store import (
    FOLDER,
    checkpoint_path,
    checkpoint_steps,
    read_about,
    read_tree,
)
from jetbot_mjx.runs.resume import to_trees
from jetbot_mjx.training.ppo_trainer import CompiledTrainer

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "smoke.yaml"
INTERVAL = 65_536
"""Environment steps between two checkpoints: half a second."""
SETTINGS = ("evaluation.episodes=16",)

BEFORE_FIRST = "before the first save"
STARTING = "starting again"
TRAINING = "training"
EVALUATING = "evaluating"
SAVING = "saving"
PHASES = (BEFORE_FIRST, STARTING, TRAINING, EVALUATING, SAVING)

TRAINER = ("-m", "jetbot_mjx.train")
"""Arguments of Python for the training command."""

_PATIENCE = 300.0


class Broken(Exception):
    """What should survive a kill, and did not."""


class Process:
    """A training in a process of its own, watched from outside; a context manager that ends it."""

    def __init__(
        self,
        run_dir: Path,
        settings: Sequence[str],
        program: Sequence[str] = TRAINER,
    ) -> None:
        """Starts it.

        Args:
          run_dir: the run folder; what is printed goes into two files beside it.
          settings: as for `--set`.
          program: arguments of Python that stand for the trainer.
        """
        self.run_dir = run_dir
        self._out, self._err = (run_dir.with_suffix(suffix) for suffix in (".out", ".err"))
        self._left_by_others = _unfinished(run_dir)
        arguments = ["--config", str(CONFIG), "--run-dir", str(run_dir)]
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
        """What it has printed so far."""
        return self._out.read_text(encoding="utf-8")

    @property
    def stderr(self) -> str:
        """What it has complained of so far."""
        return self._err.read_text(encoding="utf-8")

    @property
    def seconds_silent(self) -> float:
        """How long ago it printed its last line."""
        return time.time() - self._out.stat().st_mtime

    @property
    def unfinished(self) -> set[str]:
        """Names of the checkpoints that this process has begun and not finished."""
        return _unfinished(self.run_dir) - self._left_by_others

    @property
    def code(self) -> int | None:
        """Its exit code; None while it runs."""
        return self._process.poll()

    def send(self, number: int) -> None:
        """Sends a signal."""
        self._process.send_signal(number)

    def wait(self) -> int:
        """Waits for its end, and gives its exit code."""
        return self._process.wait(_PATIENCE)

    def until(self, condition: Callable[[], bool]) -> None:
        """Waits until something is so.

        Raises:
          Broken: the process ended before, or it took too long.
        """
        began = time.monotonic()
        while not condition():
            # Cleared away by this process, seconds before the same name may come again.
            self._left_by_others &= _unfinished(self.run_dir)
            if self.code is not None:
                raise Broken(f"ended too early with {self.code}:\n{self.stdout}{self.stderr}")
            if time.monotonic() - began > _PATIENCE:
                raise Broken(f"nothing came in {_PATIENCE:.0f} s:\n{self.stdout}{self.stderr}")
            time.sleep(0.001)

    def __enter__(self) -> "Process":
        """Enters."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Ends the process if it still runs, and whatever it has started."""
        # What is left alone by its parent, such as the probe of a library that MuJoCo imports,
        # would complain into the files of the next process.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


class Outcome(NamedTuple):
    """What a training leaves that must not depend on how often it was stopped."""

    fingerprint: str
    """As printed at the end."""
    digests: Mapping[str, str]
    """Of the trees of its last checkpoint: the whole training state."""
    progress: Mapping[str, Any]
    """Of the last checkpoint, without its clock."""
    metrics: Sequence[Mapping[str, Any]]
    """The lines of `metrics.jsonl`, without their clocks."""


def finish(run_dir: Path, settings: Sequence[str], program: Sequence[str] = TRAINER) -> Outcome:
    """Runs a training to its end, from wherever it stands.

    Args:
      run_dir: the run folder.
      settings: as for `--set`.
      program: arguments of Python that stand for the trainer.

    Returns:
      What it leaves.

    Raises:
      Broken: it did not end well.
    """
    known = checkpoint_steps(run_dir)
    with Process(run_dir, settings, program) as process:
        code = process.wait()
    check_start(process, known)
    if code != 0:
        raise Broken(f"ended with {code}:\n{process.stdout}{process.stderr}")
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


def make_template(settings: Sequence[str]) -> TrainState:
    """Shapes and dtypes of the state that such a training saves."""
    config = load_config(CONFIG, settings)
    return CompiledTrainer.from_config(config, make_env(config)).template()


def check_checkpoint(run_dir: Path, env_steps: int, template: TrainState) -> None:
    """Reads one checkpoint whole, and raises where it is not as it was written."""
    for name, tree in to_trees(template).items():
        read_tree(checkpoint_path(run_dir, env_steps), name, tree)


def check_start(process: Process, known: Sequence[int]) -> None:
    """Checks that a process went on from where it should.

    Args:
      process: it has ended.
      known: environment steps of the checkpoints that it found.

    Raises:
      Broken: it went on from elsewhere, passed something over, or left a traceback.
    """
    printed = process.stdout + process.stderr
    told = [
        int(steps.replace(",", "")) for steps in re.findall(r"resuming after ([\d,]+)", printed)
    ]
    started = "run folder: " in printed or "best policy: " in printed
    wanted = [known[-1]] if known and (started or told) else []
    if told != wanted or "skipped: " in printed or "Traceback" in printed:
        raise Broken(f"found {list(known)}, should go on after {wanted}, and said:\n{printed}")


class Aim(NamedTuple):
    """When to kill a process."""

    event: str
    """What to wait for: `started`, `trained`, `reported`, `saving` or `saved`."""
    delay: float
    """How long to wait after it [s]."""
    count: int = 1
    """At which occurrence of it in this process, for the last three."""


class Kill(NamedTuple):
    """One kill."""

    phase: str
    known: int
    """How many checkpoints there were afterwards."""


def draw_aims(kills: int, rng: random.Random) -> list[Aim]:
    """Draws when to kill, such that every phase gets its share."""
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
) -> Kill:
    """Starts a training, kills it, and checks what it leaves.

    Args:
      run_dir: the run folder.
      settings: as for `--set`.
      aim: when.
      template: shapes and dtypes of a state.
      program: arguments of Python that stand for the trainer.

    Returns:
      In which phase the kill fell.

    Raises:
      Broken: the process ended by itself, or did not go on from where it should.
      CheckpointError: a checkpoint is not whole.
    """
    known = checkpoint_steps(run_dir)
    with Process(run_dir, settings, program) as process:
        process.until(_condition(process, known, aim))
        moment = time.monotonic() + aim.delay
        process.until(lambda: time.monotonic() > moment)
        printed, silence = process.stdout, process.seconds_silent
    check_start(process, known)
    left = checkpoint_steps(run_dir)
    for steps in left:
        check_checkpoint(run_dir, steps, template)
    if process.unfinished:
        phase = SAVING
    elif not left:
        phase = BEFORE_FIRST
    else:
        phase = _phase(printed, silence)
    return Kill(phase, len(left))


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
    """Where a process was that did not save, from what it has printed.

    Args:
      printed: until the kill.
      silence: how long before that its last line came [s].
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
    return {path.name for path in folder.iterdir() if "orbax-checkpoint-tmp" in path.name}


def table(kills: Sequence[Kill]) -> str:
    """How many kills fell into which phase."""
    count = collections.Counter(one.phase for one in kills)
    rows = [f"| {phase:<24} | {count[phase]:>5} |" for phase in PHASES]
    return "\n".join(
        ["| phase                    | kills |", "|:-------------------------|------:|", *rows]
    )


def differences(one: Outcome, other: Outcome) -> list[str]:
    """The names of what differs."""
    return [name for name in Outcome._fields if getattr(one, name) != getattr(other, name)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, kills, prints the table and the verdict.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 1 where something did not survive.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--kills", type=cli.positive_int, default=50, help="default: 50")
    parser.add_argument("--seed", type=int, default=0, help="of the moments; default: 0")
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
        undisturbed = finish(folder / "undisturbed", settings)
        print(f"undisturbed: {timesteps:,} steps, {time.monotonic() - began:.0f} s", flush=True)
        kills: list[Kill] = []
        try:
            template = make_template(settings)
            for aim in draw_aims(options.kills, random.Random(options.seed)):
                kills.append(kill(folder / "killed", settings, aim, template))
                print(
                    f"{len(kills):>4}  {aim.event} + {aim.delay:.3f} s: {kills[-1].phase},"
                    f" {kills[-1].known} checkpoints, {time.monotonic() - began:.0f} s",
                    flush=True,
                )
            found = differences(undisturbed, finish(folder / "killed", settings))
            verdict = f"not the same: {', '.join(found)}" if found else ""
        except (Broken, UserError) as error:
            verdict = str(error)
    print(table(kills))
    print(
        f"{len(kills)} kills in {time.monotonic() - began:.0f} s: "
        + (verdict or "every checkpoint whole, every start from the newest, every bit the same")
    )
    return 1 if verdict else 0


if __name__ == "__main__":
    cli.run_command(main)
