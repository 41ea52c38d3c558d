"""Write checkpoints that are complete or absent, and detect damaged ones when reading.

Motivation: a training process can be killed at any moment, also while it writes a checkpoint, and
files can be truncated, corrupted, exchanged or renamed later. Neither may cost an earlier
checkpoint, and a damaged checkpoint must never be loaded as if it were a good one.

Protocol:

1. Write: a thread writes each checkpoint under a temporary name, has the disk hold all of it, and
   renames it to `checkpoints/<env_steps>/`. A process that dies leaves at most a temporary folder,
   which the next one removes, and so does a loss of power.
2. Digests: the folder holds one or more trees of arrays and `about`, a JSON object. `about` also
   holds the SHA-256 of each tree and of itself. Of a joined tree, the bytes of all arrays are
   written as one, which is faster, and `about` holds their names, dtypes and shapes.
3. Read: a reader recomputes the digests and compares the folder's name with the stored
   `env_steps`. If anything differs, it raises a `CheckpointError` with the reason.
4. Damage: a damaged checkpoint is never repaired or deleted. `resume` skips it, continues from the
   newest usable one, and moves those that are newer to `set_aside/`, so that the training can write
   its own under their names.
5. Drive: if a drive does not answer, as one on a network may for a while, that says nothing of what
   it holds. Then an `UnreadableError` ends the training, and no checkpoint is skipped.
6. Delete: a checkpoint that is removed is renamed first, so that a half-deleted one never has a
   valid name.

Arguments for this protocol: arrays are stored by name, as NumPy arrays from the host, so that the
files depend neither on a Python class nor on the number of devices. The digests cover names,
dtypes, shapes and bytes, so they reveal every change of the content.
"""

import contextlib
import hashlib
import itertools
import json
import math
import os
import re
import shutil
import stat
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import tensorstore as ts
from jaxtyping import PyTree

from jetbot_mjx.errors import (
    NotFoundError,
    UnreadableError,
    UserError,
    check_answer,
    clipped,
    os_errors,
    shown,
)
from jetbot_mjx.runs.checkpoint_writer import key_value_store, write_arrays
from jetbot_mjx.runs.durable import make_folders, move, sync_tree
from jetbot_mjx.runs.run_dir import JsonObject, read_text, remove

FOLDER = "checkpoints"
"""Name of the folder of checkpoints in a run folder."""

_ABOUT = "about"
_DIGESTS = "sha256"
_JOINED = "joined"
_BYTES = "bytes"
EARLY_SUCCESS = 0.4
"""Success rate of a policy early in its training: it drives, and fails visibly."""

_SCORE = "score"
_STEP_DIGITS = 12
_SPARE_BYTES = 1_000_000
_HIDDEN = ".{}.unfinished"
"""Name of a checkpoint that is not complete yet, or no longer."""

_UNSUSPECTED_BYTES = 1_000_000_000
_MOST_COMPRESSED = 1_000
"""Arrays of more bytes than the first of these are read only if their files hold at least this part
of them. Metadata alone can ask for any amount of memory."""

_OS_ERROR = re.compile(r"os_error_code='(\d+)'")
"""Matches the system's reason for an error of TensorStore."""

_SOURCE_LOCATIONS = re.compile(r"\s*\[source locations='[^']*'\]")
"""Matches the list of its own source files that some releases of TensorStore add to an error."""


_Typed = np.ndarray | jax.ShapeDtypeStruct | ts.TensorStore
"""An array, or the description of one."""


class CheckpointError(UserError):
    """Raised when a checkpoint is missing or cannot be used."""


class CheckpointNotFoundError(CheckpointError, NotFoundError):
    """Raised when there is no checkpoint at a path."""


class CheckpointStore(contextlib.AbstractContextManager["CheckpointStore"]):
    """A `CheckpointStore` writes the checkpoints of one run.

    It is a context manager that waits for the last write. Writing runs in the background, one
    checkpoint at a time. A checkpoint has a temporary name until it is complete, so a process that
    dies leaves the earlier checkpoints unchanged.
    """

    def __init__(self, run_dir: Path, keep: int) -> None:
        """Open a run's checkpoint folder.

        Unfinished files of an earlier process are removed before the first checkpoint.

        Args:
          run_dir: the run folder, which must exist.
          keep: the number of latest checkpoints to keep, besides the first and the best.

        Raises:
          CheckpointError: the folder cannot be written.
          UnreadableError: the drive does not answer.
        """
        self._scores = {step: stored_score(run_dir, step) for step in checkpoint_steps(run_dir)}
        self._run_dir, self._keep = run_dir.absolute(), keep
        self._folder = self._run_dir / FOLDER
        self._thread = ThreadPoolExecutor(1, "checkpoints")
        self._write: Future[None] | None = None
        with self._writing():
            for path in self._folder.glob(_HIDDEN.format("*")):
                remove(path)
            make_folders(self._folder)

    def save(
        self,
        env_steps: int,
        trees: Mapping[str, PyTree],
        about: JsonObject,
        score: float | None,
        joined: Collection[str] = (),
    ) -> None:
        """Start to write one checkpoint in the background.

        Args:
          env_steps: the number of environment steps so far, which is the name of the folder.
          trees: the trees of arrays on the host, by name.
          about: the metadata of the trees, as JSON values.
          score: the number by which the best checkpoint is found; None if the policy was not
            evaluated.
          joined: the names of the trees whose arrays are written as one.

        Raises:
          CheckpointError: this checkpoint, or the one before, could not be written.
        """
        with self._writing():
            self._wait()
            # Copy the arrays, which may change while they are written.
            flat = {
                name: {key: np.array(x) for key, x in flatten(tree).items()}
                for name, tree in trees.items()
            }
            self._check_space(sum(x.nbytes for tree in flat.values() for x in tree.values()))
            if env_steps <= max(self._scores, default=-1):
                raise ValueError(f"there is one after {env_steps} steps or more")
        self._scores[env_steps] = -math.inf if score is None else score
        about = {**about, "env_steps": env_steps, _SCORE: score}
        path = checkpoint_path(self._run_dir, env_steps)
        self._write = self._thread.submit(self._write_one, path, flat, about, joined)

    def _write_one(
        self,
        path: Path,
        trees: Mapping[str, Mapping[str, np.ndarray]],
        about: JsonObject,
        joined: Collection[str],
    ) -> None:
        """Write a checkpoint, and delete those that it replaces."""
        # Add the digests by which a reader recognises damage.
        digests = {name: digest(tree) for name, tree in trees.items()}
        about = {
            **about,
            _DIGESTS: digests,
            _JOINED: {name: _table(trees[name]) for name in joined},
        }
        about[_DIGESTS] = {**digests, _ABOUT: _digest_json(about)}
        # Write under a temporary name, and rename what the disk holds.
        unfinished = path.with_name(_HIDDEN.format(path.name))
        try:
            # Without its parents: a run folder that was moved away is not made again.
            unfinished.mkdir()
            (unfinished / _ABOUT).mkdir()
            (unfinished / _ABOUT / "metadata").write_text(json.dumps(about))
            for name, tree in trees.items():
                write_arrays(unfinished / name, _join(tree) if name in joined else tree)
            sync_tree(unfinished)
            move(unfinished, path)
        finally:
            remove(unfinished)
        self._delete_superseded()

    def _delete_superseded(self) -> None:
        """Delete all but the latest, the first and the best, which of equals is the later one."""
        steps = checkpoint_steps(self._run_dir)
        best = max(steps, key=lambda step: (self._scores.get(step, -math.inf), step))
        for step in steps[1 : -self._keep]:
            if step != best:
                path = checkpoint_path(self._run_dir, step)
                hidden = path.with_name(_HIDDEN.format(path.name))
                move(path, hidden)
                remove(hidden)

    def _wait(self) -> None:
        """Wait for the last write, and raise its error."""
        write, self._write = self._write, None
        if write is not None:
            write.result()

    def __exit__(self, *exception: object) -> None:
        """Wait until all checkpoints are on disk, and close the store."""
        with self._thread, self._writing():
            self._wait()

    def _check_space(self, size: int) -> None:
        """Raise a `CheckpointError` if the disk has no room for a checkpoint of this size [bytes].

        The check comes before the write, so that no write starts that cannot finish.
        """
        needed, free = size + _SPARE_BYTES, shutil.disk_usage(self._folder).free
        if free < needed:
            raise CheckpointError(
                f"{self._folder}: the disk is full: a checkpoint needs {needed / 1e6:.1f} MB, and"
                f" {free / 1e6:.1f} MB are free; the earlier checkpoints are unchanged"
            )

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Convert every exception of a failed write to a one-line `CheckpointError`."""
        try:
            yield
        except UserError:
            raise
        except Exception as error:
            left = "; the earlier ones are unchanged" if os.path.isdir(self._folder) else ""
            raise CheckpointError(
                f"{self._folder}: a checkpoint could not be written: {_reason(error)}{left}"
            ) from error


def checkpoint_steps(run_dir: Path) -> list[int]:
    """Return the environment steps of a run's complete checkpoints in ascending order.

    Raises:
      UnreadableError: they cannot be listed.
    """
    with os_errors(f"{run_dir / FOLDER} cannot be read", UnreadableError):
        try:
            names = os.listdir(run_dir / FOLDER)
        except (FileNotFoundError, NotADirectoryError):
            return []
    found = {int(name) for name in names if name.isdecimal()}
    # Skip folders that spell the number differently: this project did not write them.
    return sorted(step for step in found if checkpoint_path(run_dir, step).name in names)


def checkpoint_path(run_dir: Path, env_steps: int) -> Path:
    """Return the path of the checkpoint at that many environment steps."""
    return run_dir / FOLDER / f"{env_steps:0{_STEP_DIGITS}d}"


def set_aside(path: Path) -> Path:
    """Move a checkpoint to `set_aside/`, so that it does not collide with those written later.

    Args:
      path: a checkpoint folder of a run.

    Returns:
      Its new path, in the run's `set_aside/`.

    Raises:
      CheckpointError: it cannot be moved.
    """
    folder = path.parent.parent / "set_aside"
    with os_errors(f"checkpoint {path} cannot be moved into {folder}", CheckpointError):
        make_folders(folder)
        numbers = (folder / f"{path.name}.{number}" for number in itertools.count())
        free = next(free for free in numbers if not os.path.lexists(free))
        move(path, free)
        return free


def read_about(path: Path, required: Sequence[str] = ()) -> JsonObject:
    """Read the metadata of a checkpoint and verify its digest.

    Args:
      path: the checkpoint folder.
      required: keys that must be present.

    Returns:
      The JSON object.

    Raises:
      CheckpointError: the metadata is missing or incomplete, or changed after it was written.
      UnreadableError: the drive does not answer.
    """
    # Read the file and compare it with its own digest.
    file = path / _ABOUT / "metadata"
    try:
        text = read_text(file)
        about = json.loads(text)
        stored_digest = about[_DIGESTS].pop(_ABOUT)
        is_intact = stored_digest == _digest_json(about)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise CheckpointError(
            f"checkpoint {path} is not one of jetbot_mjx: {file.relative_to(path)} is missing"
            " or damaged"
        ) from None
    if not is_intact:
        raise CheckpointError(
            f"checkpoint {path} is damaged: {file.relative_to(path)} changed after it was written"
        )
    # Check the content: the required keys, and the step that the folder's name states.
    for key in required:
        if key not in about:
            raise CheckpointError(f"checkpoint {path} has unusable metadata: no {key}")
    if path.name.isdecimal() and int(path.name) != about.get("env_steps"):
        raise CheckpointError(
            f"checkpoint {path} was renamed: it was written after"
            f" {shown(about.get('env_steps'))} steps"
        )
    return about


def read_tree(path: Path, name: str, template: PyTree) -> PyTree:
    """Read one tree of arrays and verify its digest.

    Args:
      path: the checkpoint folder.
      name: the name of the tree.
      template: a tree of the expected structure, whose leaves have the expected shapes and dtypes.

    Returns:
      A tree of NumPy arrays with the structure of the template.

    Raises:
      CheckpointError: the tree is missing, has other names, shapes or dtypes, cannot be read, or
        changed after it was written.
      UnreadableError: the drive does not answer.
    """
    about = read_about(path)
    if name not in about[_DIGESTS]:
        raise CheckpointError(f"checkpoint {path} holds no {name}")
    wanted, folder = flatten(template), path / name
    try:
        table = about.get(_JOINED, {}).get(name)
        with _answers(path):
            if table is None:
                flat = _read_arrays(folder, wanted)
            else:
                _compare(folder, wanted, _shapes(table))
                flat = _split(folder, table)
    except UserError:
        raise
    except OSError as error:
        raise CheckpointError(
            f"checkpoint {path} cannot be read: {name}: {error.strerror}"
        ) from None
    # TensorStore reports a damaged folder by many kinds of exception.
    except Exception:
        raise CheckpointError(
            f"checkpoint {path} cannot be read: a file in {name} is damaged or missing"
            f"{_other(path)}"
        ) from None
    if digest(flat) != about[_DIGESTS][name]:
        raise CheckpointError(
            f"checkpoint {path} is damaged: {name} changed after it was written{_other(path)}"
        )
    return jax.tree.unflatten(jax.tree.structure(template), [flat[key] for key in wanted])


def _other(path: Path) -> str:
    """Return where the latest other checkpoint of the run is, to be added to a message."""
    try:
        steps = [each for each in checkpoint_steps(path.parent.parent) if each != int(path.name)]
    except (UserError, ValueError):  # the message is about something else
        return ""
    return f"; another one is {checkpoint_path(path.parent.parent, steps[-1])}" if steps else ""


def flatten(tree: PyTree) -> dict[str, PyTree]:
    """Return the leaves of a tree by their path, such as `params.policy.hidden_0.bias`.

    Raises:
      CheckpointError: two leaves have the same path, as those of `{"a.b": 1, "a": {"b": 2}}`.
    """
    found: dict[str, PyTree] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        if name in found:
            raise CheckpointError(f"two arrays of the state are called {name}: rename one of them")
        found[name] = leaf
    return found


def digest(tree: PyTree) -> str:
    """Return the SHA-256 of names, dtypes, shapes and bytes of a tree's leaves, in hexadecimal."""
    total = hashlib.sha256()
    for name, leaf in sorted(flatten(tree).items()):
        array = np.ascontiguousarray(leaf)
        total.update(f"{name} {array.dtype.str} {np.shape(leaf)}\n".encode())
        # Arrays of bfloat16 have no buffer of their own type.
        total.update(array.reshape(-1).view(np.uint8).data)
    return total.hexdigest()


def stored_score(run_dir: Path, env_steps: int) -> float:
    """Return the score of a checkpoint, -infinity if it was not evaluated or is damaged."""
    try:
        score = read_about(checkpoint_path(run_dir, env_steps)).get(_SCORE)
    except CheckpointError:
        return -math.inf
    return score if isinstance(score, int | float) and math.isfinite(score) else -math.inf


def early_checkpoint(success_rates: Mapping[int, float]) -> int:
    """Choose the checkpoint that shows a policy early in its training.

    Args:
      success_rates: The success rate of each candidate by its environment steps, in ascending
        order; at least one.

    Returns:
      The environment steps of the first one whose rate is closest to `EARLY_SUCCESS`.
    """
    return min(success_rates, key=lambda step: abs(success_rates[step] - EARLY_SUCCESS))


@contextlib.contextmanager
def _answers(path: Path) -> Iterator[None]:
    """Convert an error of a drive that does not answer to an `UnreadableError`."""
    try:
        yield
    except Exception as error:
        check_answer(_error_number(error), f"checkpoint {path}")
        raise


def _error_number(error: Exception) -> int | None:
    """Return the number of the system's error that Python or TensorStore reports."""
    if isinstance(error, OSError):
        return error.errno
    found = _OS_ERROR.search(str(error))
    return int(found[1]) if found else None


def _digest_json(values: JsonObject) -> str:
    text = json.dumps(values, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _read_arrays(folder: Path, wanted: Mapping[str, _Typed]) -> dict[str, np.ndarray]:
    """Read arrays one after the other, and raise at the first wrong one.

    Orbax itself reads in threads. If one of them fails, the others print tracebacks that the
    caller cannot catch.
    """
    try:
        os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        raise CheckpointError(
            f"checkpoint {folder.parent} cannot be read: {folder.name} is missing"
        ) from None
    stored_bytes = _count_bytes(folder)
    files = key_value_store(folder)
    keys = [key.decode() for key in ts.KvStore.open(files).result().list().result()]
    names = [key.removesuffix("/.zarray") for key in keys if key.endswith("/.zarray")]
    stored = {}
    for name in names:
        place = {**files, "path": f"{name}/"}
        stored[name] = ts.open({"driver": "zarr", "kvstore": place}, read=True).result()
    _compare(folder, wanted, stored)
    # TensorStore reads whole chunks, and fills those that no file holds. A scalar has no chunk.
    needed = sum(
        array.dtype.numpy_dtype.itemsize * max(math.prod(array.shape), math.prod(chunk))
        for array in stored.values()
        for chunk in [array.chunk_layout.read_chunk.shape or ()]
    )
    if needed > max(_UNSUSPECTED_BYTES, _MOST_COMPRESSED * stored_bytes):
        raise CheckpointError(
            f"checkpoint {folder.parent} cannot be read: {folder.name} asks for {needed:.1e} bytes"
            f" of memory, and its files hold {stored_bytes:,}"
        )
    return {name: array.read().result() for name, array in stored.items()}


def _count_bytes(folder: Path) -> int:
    """Return the size of all files below a folder, which must be regular ones [bytes].

    TensorStore would wait for ever for a named pipe.
    """
    total = 0
    for parent, _, names in os.walk(folder):
        for file in (Path(parent, name) for name in names):
            status = file.stat()
            if not stat.S_ISREG(status.st_mode):
                name = file.relative_to(folder.parent)
                raise CheckpointError(
                    f"checkpoint {folder.parent} cannot be read: {name}: it is not a regular file"
                )
            os.close(os.open(file, os.O_RDONLY))
            total += status.st_size
    return total


def _compare(folder: Path, wanted: Mapping[str, _Typed], stored: Mapping[str, _Typed]) -> None:
    """Compare names, shapes and dtypes of arrays before anything is read."""
    for name in sorted(wanted.keys() | stored.keys()):
        ours, theirs = (_describe(arrays.get(name)) for arrays in (wanted, stored))
        if ours != theirs:
            raise CheckpointError(
                f"checkpoint {folder.parent} cannot be read: {name} is {theirs}, and should be"
                f" {ours}"
            )


_Table = Sequence[tuple[str, str, Sequence[int]]]
"""Names, dtypes and shapes of the arrays of a joined tree, in the order of their bytes."""


def _table(arrays: Mapping[str, np.ndarray]) -> _Table:
    return [(name, str(x.dtype), list(x.shape)) for name, x in arrays.items()]


def _shapes(table: _Table) -> dict[str, jax.ShapeDtypeStruct]:
    return {name: jax.ShapeDtypeStruct(shape, dtype) for name, dtype, shape in table}


def _join(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the bytes of arrays as the only array of a tree."""
    return {_BYTES: np.frombuffer(b"".join(x.tobytes() for x in arrays.values()), np.uint8)}


def _split(folder: Path, table: _Table) -> dict[str, np.ndarray]:
    """Read the bytes of a joined tree, and return its arrays."""
    shapes = _shapes(table)
    sizes = [math.prod(x.shape) * x.dtype.itemsize for x in shapes.values()]
    wanted = {_BYTES: jax.ShapeDtypeStruct((sum(sizes),), np.uint8)}
    content = _read_arrays(folder, wanted)[_BYTES]
    parts = np.split(content, np.cumsum(sizes)[:-1])
    return {
        name: part.view(x.dtype).reshape(x.shape)
        for (name, x), part in zip(shapes.items(), parts, strict=True)
    }


def _reason(error: Exception) -> str:
    """Return the reason for an error in one line of at most 305 characters.

    It is the system's if it is known. Locations in the source of other libraries are left out.
    """
    if number := _error_number(error):
        return os.strerror(number)
    text = _SOURCE_LOCATIONS.sub("", str(error))
    lines = text.strip().splitlines() or [type(error).__name__]
    # A message of TensorStore begins with the operation and ends with the cause: keep both ends.
    return clipped(lines[0])


def _describe(array: _Typed | None) -> str:
    if array is None:
        return "missing"
    return f"{getattr(array.dtype, 'numpy_dtype', array.dtype)}{list(array.shape)}"
