"""Cut the power at every moment of what is stored: `python benchmarks/reliability/power_loss.py`.

Each scenario stores something in a process of its own, whose system calls are recorded (Linux, with
strace). Then all states are made that the disk may hold after a loss of power, and in each of them
the project's own reader has to find what was confirmed before, or what was written after it. Never
less, and nothing else. `disk_replay.py` says which states these are.
"""

import argparse
import contextlib
import hashlib
import os
import random
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS, ROOT
from benchmarks.harness.disk_replay import CONFIRMED, record, states, write_state
from benchmarks.harness.results import check_output, write
from jetbot_mjx import cli
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import run_dir
from jetbot_mjx.runs.checkpoint_store import (
    CheckpointError,
    CheckpointStore,
    checkpoint_path,
    checkpoint_steps,
    read_tree,
    set_aside,
)
from jetbot_mjx.runs.metrics import METRICS, JsonlSink, read_history
from jetbot_mjx.runs.run_dir import versions
from onekernel.trusted_files import read_trusted, write_private

_TREES, _STEPS = ("policy", "training"), (0, 100, 200, 300)


def confirm(name: str) -> None:
    """Say in the recording that from here on something is stored."""
    os.access(CONFIRMED / name, os.F_OK)


def last(confirmed: Sequence[str], kind: str) -> int:
    """Return the number that was confirmed last of a kind; -1 if there was none."""
    numbers = [int(x.partition("=")[2]) for x in confirmed if x.startswith(f"{kind}=")]
    return numbers[-1] if numbers else -1


def tree_at(steps: int, name: str) -> dict[str, np.ndarray]:
    """Return the arrays of a checkpoint."""
    rng = np.random.default_rng(steps + len(name))
    return {"a": rng.random(300, np.float32), "b": rng.integers(0, 9, (4, 5)), "c": np.array(steps)}


def store_run(folder: Path) -> None:
    """Store what a training does: configuration, metrics, and checkpoints of which old ones go."""
    run = folder / "runs" / "mine"
    with run_dir.occupied(run):
        run_dir.write_run(run, load_config(CONFIGS / "smoke.yaml"), {"packages": {}})
        confirm("config=1")
        metrics = JsonlSink(run / METRICS)
        for steps in _STEPS:
            metrics.write(steps, {"loss": steps / 7})
            confirm(f"line={steps}")
            with CheckpointStore(run, keep=1) as store:
                store.save(steps, {x: tree_at(steps, x) for x in _TREES}, {}, 0.5, _TREES[1:])
            confirm(f"checkpoint={steps}")
        metrics.close()
        # The newest is moved, as if it was damaged, and only the first is left.
        confirm("checkpoint=0")
        set_aside(checkpoint_path(run, 300))
        with CheckpointStore(run, keep=2) as store:
            for steps in (300, 400):
                store.save(steps, {x: tree_at(steps, x) for x in _TREES}, {}, 0.7, _TREES[1:])
        confirm("checkpoint=400")


def check_run(folder: Path, confirmed: Sequence[str]) -> str | None:
    """Return what a resumed training would miss."""
    run = folder / "runs" / "mine"
    if "config=1" in confirmed:
        run_dir.read_config(run)
    found, lines = _newest_usable(run), [entry.env_steps for entry in read_history(run / METRICS)]
    if found < (needed := last(confirmed, "checkpoint")):
        return f"the newest checkpoint is that of {found} steps, and {needed} were confirmed"
    if max(lines, default=-1) < max(last(confirmed, "line"), min(found, _STEPS[-1])):
        return f"metrics end after {lines}, and there is a checkpoint of {found} steps"
    return None


def _newest_usable(run: Path) -> int:
    """Return the steps of the newest checkpoint that can be read, -1 if there is none.

    Raises:
      UserError: one can be read that was not written so.
    """
    for steps in reversed(checkpoint_steps(run)):
        path = checkpoint_path(run, steps)
        files = sorted(file for file in path.rglob("*") if file.is_file())
        content = [(str(file.relative_to(path)), file.read_bytes()) for file in files]
        key = hashlib.sha256(repr((steps, content)).encode()).hexdigest()
        if key not in _readable:
            _readable[key] = _is_readable(path, steps)
        if _readable[key]:
            return steps
    return -1


_readable: dict[str, bool] = {}
"""Whether a checkpoint can be read, by its content: most states share theirs with others."""


def _is_readable(path: Path, steps: int) -> bool:
    for name in _TREES:
        wanted = tree_at(steps, name)
        try:
            read = read_tree(path, name, wanted)
        except CheckpointError:
            return False
        if any((read[key] != wanted[key]).any() for key in wanted):
            raise UserError(f"{path.name} has other numbers than those that were stored")
    return True


def store_files(folder: Path) -> None:
    """Store what tuning, fitting and reports write, one after the other."""
    for version in range(3):
        run_dir.write_text(folder / "tuned.yaml", f"version: {version}\n" + _FILLING)
        confirm(f"version={version}")


def check_files(folder: Path, confirmed: Sequence[str]) -> str | None:
    """Return what is wrong with the file."""
    return _check_version([folder / "tuned.yaml"], last(confirmed, "version"))


def store_export(folder: Path) -> None:
    """Store what an export writes, in the place of the one before."""
    for version in range(3):
        with run_dir.atomic_folder(folder / "policy") as unfinished:
            for name in _EXPORTED:
                (unfinished / name).parent.mkdir(exist_ok=True)
                (unfinished / name).write_text(f"version: {version}\n" + _FILLING)
        confirm(f"version={version}")


def check_export(folder: Path, confirmed: Sequence[str]) -> str | None:
    """Return what is wrong with the export."""
    if not (folder / "policy").exists() and not confirmed:
        return None
    files = [folder / "policy" / name for name in _EXPORTED]
    return _check_version(files, last(confirmed, "version"))


_EXPORTED = ("policy.json", "policy.py", "more/policy.bin")

_FILLING = "# so that it has several blocks\n" * 100


def _check_version(files: Sequence[Path], confirmed: int) -> str | None:
    """Return what is wrong with files that are all of the confirmed version, or of a later one."""
    if confirmed < 0 and not files[0].exists():
        return None
    texts = {file.read_text() for file in files}
    allowed = {f"version: {version}\n" + _FILLING for version in range(max(confirmed, 0), 3)}
    if len(texts) == 1 and texts <= allowed:
        return None
    return f"{files[0].name}: {sorted(text[:20] for text in texts)}, confirmed {confirmed}"


def store_programs(folder: Path) -> None:
    """Store compiled programs under the same name, as the program cache does."""
    cache = folder / "cache"
    cache.mkdir(mode=0o700)
    for version in range(3):
        write_private(cache / "program", f"version: {version}\n{_FILLING}".encode())
        confirm(f"version={version}")


def check_programs(folder: Path, confirmed: Sequence[str]) -> str | None:
    """Return what is wrong with the program that is read; none at all is compiled again."""
    content = read_trusted(folder / "cache" / "program")
    if content in (None, *(f"version: {version}\n{_FILLING}".encode() for version in range(3))):
        return None
    return f"the program begins with {content[:20]!r}"


def store_study(folder: Path) -> None:
    """Store trials of a search for hyperparameters."""
    from jetbot_mjx.tuning.search import Search
    from jetbot_mjx.tuning.space import read_space

    config = load_config(CONFIGS / "smoke.yaml")
    space = read_space({"ppo.learning_rate": {"low": 1e-4, "high": 1e-2}}, config)
    study = Search(config, space, folder / "study").study
    for number in range(3):
        study.tell(study.ask(), 0.5)
        confirm(f"trial={number}")


def check_study(folder: Path, confirmed: Sequence[str]) -> str | None:
    """Return what is wrong with the study."""
    file = folder / "study" / "study.db"
    if not confirmed:
        return None
    with contextlib.closing(sqlite3.connect(file)) as database:
        (sound,) = database.execute("PRAGMA integrity_check").fetchone()
        (done,) = database.execute(
            "SELECT COUNT(*) FROM trials WHERE state = 'COMPLETE'"
        ).fetchone()
    if sound != "ok":
        return f"SQLite says {sound}"
    if done < last(confirmed, "trial") + 1:
        return f"{done} trials, and {last(confirmed, 'trial') + 1} were confirmed"
    return None


class Scenario(NamedTuple):
    """A `Scenario` stores something, and reads what a loss of power left."""

    store: Callable[[Path], None]
    check: Callable[[Path, Sequence[str]], str | None]


SCENARIOS = {
    "run": Scenario(store_run, check_run),
    "files": Scenario(store_files, check_files),
    "export": Scenario(store_export, check_export),
    "programs": Scenario(store_programs, check_programs),
    "study": Scenario(store_study, check_study),
}


class Row(NamedTuple):
    """A `Row` holds what became of a scenario."""

    scenario: str
    operations: int
    syncs: int
    states: int
    lost: int
    """States in which something was lost or wrong."""
    first: str = ""
    """What was lost in the first of them."""


def replay(
    name: str,
    folder: Path,
    seed: int = 0,
    share: float = 1.0,
    program: Sequence[str] = (str(Path(__file__).resolve()),),
) -> Row:
    """Record a scenario, and read every state that a loss of power may leave.

    Args:
      name: the scenario.
      folder: an empty folder, for the recording and the states.
      seed: seed of the subsets that are drawn.
      share: the part of all states that is read, drawn by chance.
      program: Python's arguments, which `--store` follows.

    Raises:
      UserError: the scenario could not be recorded.
    """
    recorded, rng = folder / "recorded", random.Random(seed)
    recorded.mkdir()
    arguments = [*program, "--store", name, "--folder", str(recorded)]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    recording = record(arguments, recorded, environment)
    count, failures = 0, []
    for state, confirmed in states(recording, rng, share):
        count += 1
        write_state(folder / "disk", state)
        try:
            failure = SCENARIOS[name].check(folder / "disk", confirmed)
        except (UserError, OSError, sqlite3.Error, ValueError) as error:
            failure = f"{type(error).__name__}: {error}"
        if failure:
            failures.append(f"{failure} (confirmed: {', '.join(confirmed[-2:]) or 'nothing'})")
    syncs = sum(op.kind == "sync" for op in recording.ops)
    return Row(name, len(recording.ops), syncs, count, len(failures), (failures or [""])[0])


def main(arguments: Sequence[str] | None = None) -> int:
    """Replay all scenarios, print a table and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if a state lost what was confirmed.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=list(SCENARIOS))
    parser.add_argument("--share", type=float, default=1.0, help="part of the states to read")
    parser.add_argument("--seed", type=int, default=0, help="seed of the drawn subsets")
    parser.add_argument("--output", type=Path, help="JSON file")
    parser.add_argument("--store", choices=SCENARIOS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.store:
        SCENARIOS[options.store].store(options.folder)
        return 0
    if options.output:
        check_output(options.output)
    memory = Path("/dev/shm")
    fast = memory if os.access(memory, os.W_OK) else None
    print(f"{'scenario':10}{'operations':>11}{'syncs':>7}{'states':>9}{'lost':>6}{'[s]':>7}")
    rows = []
    for name in options.scenarios:
        began = time.perf_counter()
        with tempfile.TemporaryDirectory(dir=fast) as folder:
            rows.append(row := replay(name, Path(folder), options.seed, options.share))
        numbers = f"{row.operations:11,}{row.syncs:7,}{row.states:9,}{row.lost:6,}"
        seconds = time.perf_counter() - began
        print(f"{name:10}{numbers}{seconds:7.0f}  {row.first}".rstrip(), flush=True)
    if options.output:
        results = [row._asdict() for row in rows]
        write(options.output, {"seed": options.seed, "versions": versions(), "rows": results})
    return int(any(row.lost for row in rows))


if __name__ == "__main__":
    cli.run_command(main)
