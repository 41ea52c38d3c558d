"""Checkpoints on disk, by Orbax: whole or absent, and nothing is taken for what it is not.

`<folder>/<env_steps>/` holds one or more trees of arrays and `about`, a JSON object. `about`
also holds a SHA-256 of each tree and of itself: what was cut, flipped, exchanged or renamed
since it was written is refused with the reason. Arrays are stored by name, as NumPy arrays
from the host: what is on disk depends on no Python class and on no number of devices.
"""

import contextlib
import hashlib
import itertools
import json
import logging
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
import orbax.checkpoint as ocp
import tensorstore as ts
from orbax.checkpoint import checkpoint_managers

from jetbot_mjx.errors import UserError

FOLDER = "checkpoints"
"""In a run folder."""

_ABOUT = "about"
_DIGESTS = "sha256"
_SUCCESS = "success_rate"
_STEP_DIGITS = 12
_SPARE_BYTES = 1_000_000
_DELETED = ".deleted"

_PLACES = re.compile(r"\s*\[source locations='[^']*'\]")
"""What some releases of TensorStore add to an error: file after file of its own source."""

# Orbax tells of every step of its work at INFO, of what it would prefer at WARNING, and at ERROR,
# by tracebacks from each of its threads, of what it raises as well.
logging.getLogger("absl").setLevel(logging.CRITICAL)


class CheckpointError(UserError):
    """A checkpoint that is not there, or that cannot be used."""


class Store:
    """The checkpoints of one run, for writing; a context manager that waits for the last write.

    Writing goes on in the background, one checkpoint at a time, under another name until it is
    whole: a process that dies leaves the earlier ones as they were.
    """

    def __init__(self, run_dir: Path, keep: int) -> None:
        """Opens a run's checkpoint folder, and clears away what an earlier process left unfinished.

        Args:
          run_dir: the run folder, which exists.
          keep: how many of the latest stay, besides the first and the best.
        """
        self._success = {step: _success_rate(run_dir, step) for step in checkpoint_steps(run_dir)}
        options = ocp.CheckpointManagerOptions(
            create=False,
            multiprocessing_options=_this_process_alone(),
            step_name_format=_step_names(),
            preservation_policy=_KeepSome(keep, self._success),
            cleanup_tmp_directories=True,
            # Renamed first: one that is half deleted must not stand under its name.
            todelete_subdir=_DELETED,
        )
        self._folder = (run_dir / FOLDER).absolute()
        self._clear_deleted()
        with self._writing():
            self._folder.mkdir(exist_ok=True)
            self._manager = ocp.CheckpointManager(self._folder, options=options)

    def save(
        self,
        env_steps: int,
        trees: Mapping[str, Any],
        about: Mapping[str, Any],
        success_rate: float | None,
    ) -> None:
        """Begins to write one checkpoint.

        Args:
          env_steps: environment steps so far; names the folder.
          trees: arrays on the host, by name.
          about: what explains them, as JSON.
          success_rate: by which the best is kept; None where it was not judged.

        Raises:
          CheckpointError: this one, or the one before, could not be written.
        """
        self._clear_deleted()
        # Brax's counters are JAX arrays wherever they are.
        flat = {
            name: {key: np.asarray(x) for key, x in flatten(tree).items()}
            for name, tree in trees.items()
        }
        self._check_space(sum(x.nbytes for tree in flat.values() for x in tree.values()))
        digests = {name: digest(tree) for name, tree in flat.items()}
        about = {**about, "env_steps": env_steps, _SUCCESS: success_rate, _DIGESTS: digests}
        about[_DIGESTS] = {**digests, _ABOUT: _digest_json(about)}
        items = {name: ocp.args.StandardSave(tree) for name, tree in flat.items()}
        self._success[env_steps] = -1.0 if success_rate is None else success_rate
        with self._writing():
            begun = self._manager.save(
                env_steps,
                args=ocp.args.Composite(**items, **{_ABOUT: ocp.args.JsonSave(about)}),
            )
            if not begun:
                raise ValueError(f"there is one after {env_steps} steps or more")

    def wait(self) -> None:
        """Waits until all is on disk.

        Raises:
          CheckpointError: something could not be written.
        """
        with self._writing():
            self._manager.wait_until_finished()

    def __enter__(self) -> Self:
        """Enters."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Waits until all is on disk."""
        with self._writing():
            self._manager.close()
        shutil.rmtree(self._folder / _DELETED, ignore_errors=True)

    def _clear_deleted(self) -> None:
        # The folder itself stays: Orbax may be about to move the next one in.
        for path in (self._folder / _DELETED).glob("*"):
            shutil.rmtree(path, ignore_errors=True)

    def _check_space(self, size: int) -> None:
        """Refuses before anything is begun that could not be finished."""
        needed, free = size + _SPARE_BYTES, shutil.disk_usage(self._folder).free
        if free < needed:
            raise CheckpointError(
                f"{self._folder}: the disk is full: a checkpoint needs {needed / 1e6:.1f} MB, and"
                f" {free / 1e6:.1f} MB are free; the checkpoints there are as they were"
            )

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Turns the many ways in which Orbax reports a failed write into one line."""
        try:
            yield
        except Exception as error:
            raise CheckpointError(
                f"{self._folder}: a checkpoint could not be written: {_reason(error)}; the earlier"
                " ones are as they were"
            ) from error


class _KeepSome(checkpoint_managers.PreservationPolicy):
    """The latest, the first, and the best; of equally good ones the later."""

    def __init__(self, latest: int, success: Mapping[int, float]) -> None:
        self._latest = latest
        self._success = success

    def should_preserve(
        self, checkpoints: Sequence[Any], *, context: checkpoint_managers.PreservationContext
    ) -> Sequence[bool]:
        del context
        success = [self._success.get(one.step, -1.0) for one in checkpoints]
        best = max(range(len(success)), key=lambda index: (success[index], index), default=0)
        first_of_latest = len(checkpoints) - self._latest
        return [index in (0, best) or index >= first_of_latest for index in range(len(checkpoints))]


def checkpoint_steps(run_dir: Path) -> list[int]:
    """Environment steps of a run's checkpoints, ascending; unfinished ones are left out."""
    folder = run_dir / FOLDER
    if not folder.is_dir():
        return []
    found = (int(path.name) for path in folder.iterdir() if path.name.isdecimal())
    # Other spellings of a number are not ours.
    return sorted(step for step in set(found) if os.path.lexists(checkpoint_path(run_dir, step)))


def checkpoint_path(run_dir: Path, env_steps: int) -> Path:
    """Where the checkpoint at that many environment steps lies."""
    return run_dir / FOLDER / f"{env_steps:0{_STEP_DIGITS}d}"


def set_aside(path: Path) -> Path:
    """Moves a checkpoint out of the way of those that will be written, and keeps it.

    Args:
      path: a checkpoint folder of a run.

    Returns:
      Where it lies now: in the run's `set_aside/`.

    Raises:
      CheckpointError: it cannot be moved.
    """
    folder = path.parent.parent / "set_aside"
    try:
        folder.mkdir(exist_ok=True)
        numbers = (folder / f"{path.name}.{number}" for number in itertools.count())
        return path.rename(next(free for free in numbers if not os.path.lexists(free)))
    except OSError as error:
        raise CheckpointError(
            f"checkpoint {path} cannot be moved into {folder}: {error.strerror}"
        ) from None


def read_about(path: Path, required: Sequence[str] = ()) -> dict[str, Any]:
    """Reads what explains a checkpoint.

    Args:
      path: the checkpoint folder.
      required: keys that must be there.

    Returns:
      The JSON object.

    Raises:
      CheckpointError: it is not there, not whole, or not as it was written.
    """
    file = path / _ABOUT / "metadata"
    try:
        about = json.loads(file.read_text(encoding="utf-8"))
        stated = about[_DIGESTS].pop(_ABOUT)
        whole = stated == _digest_json(about)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise CheckpointError(
            f"checkpoint {path} is not one of jetbot_mjx: {file.relative_to(path)} is missing"
            " or damaged"
        ) from None
    if not whole:
        raise CheckpointError(
            f"checkpoint {path} is damaged: {file.relative_to(path)} is not as it was written"
        )
    for key in required:
        if key not in about:
            raise CheckpointError(f"checkpoint {path} does not explain itself: no {key}")
    if path.name.isdecimal() and int(path.name) != about.get("env_steps"):
        raise CheckpointError(
            f"checkpoint {path} was renamed: it was written after {about.get('env_steps')} steps"
        )
    return about


def read_tree(path: Path, name: str, template: Any) -> Any:
    """Reads one tree of arrays.

    Args:
      path: the checkpoint folder.
      name: of the tree.
      template: a tree of the same structure, whose leaves tell shape and dtype.

    Returns:
      A tree like the template, of NumPy arrays.

    Raises:
      CheckpointError: it is not there, has other names, shapes or dtypes, cannot be read, or
        is not what was written.
    """
    about = read_about(path)
    if name not in about[_DIGESTS]:
        raise CheckpointError(f"checkpoint {path} holds no {name}")
    wanted = flatten(template)
    try:
        flat = _read_arrays(path / name, wanted)
    # TensorStore reports a damaged folder by many kinds of exception.
    except Exception as error:
        raise CheckpointError(f"checkpoint {path} cannot be read: {_reason(error)}") from None
    if digest(flat) != about[_DIGESTS][name]:
        raise CheckpointError(f"checkpoint {path} is damaged: {name} is not as it was written")
    return jax.tree.unflatten(jax.tree.structure(template), [flat[key] for key in wanted])


def flatten(tree: Any) -> dict[str, Any]:
    """Leaves by their path, such as `params.policy.hidden_0.bias`."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def digest(tree: Any) -> str:
    """SHA-256 over names, dtypes, shapes and bytes of a tree's leaves, in hexadecimal."""
    total = hashlib.sha256()
    for name, leaf in sorted(flatten(tree).items()):
        array = np.ascontiguousarray(leaf)
        total.update(f"{name} {array.dtype.str} {np.shape(leaf)}\n".encode())
        total.update(array.data)
    return total.hexdigest()


def _success_rate(run_dir: Path, env_steps: int) -> float:
    """By which a checkpoint is kept; below all others where it was not judged, or is damaged."""
    try:
        rate = read_about(checkpoint_path(run_dir, env_steps)).get(_SUCCESS)
    except CheckpointError:
        return -1.0
    return -1.0 if rate is None else rate


def _digest_json(values: Mapping[str, Any]) -> str:
    text = json.dumps(values, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _read_arrays(folder: Path, wanted: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Reads what Orbax wrote, one array after the other, and raises at the first that is wrong.

    Orbax itself reads in threads: where one fails, the others print tracebacks that nobody can
    catch.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder.name} is missing")
    files = {"driver": "ocdbt", "base": {"driver": "file", "path": f"{folder}/"}}
    keys = [key.decode() for key in ts.KvStore.open(files).result().list().result()]
    names = [key.removesuffix("/.zarray") for key in keys if key.endswith("/.zarray")]
    stored = {}
    for name in names:
        place = {**files, "path": f"{name}/"}
        stored[name] = ts.open({"driver": "zarr", "kvstore": place}, read=True).result()
    _check_arrays(wanted, stored)
    return {name: array.read().result() for name, array in stored.items()}


def _check_arrays(wanted: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    """Raises where the stored arrays are not those that are wanted."""
    for name in sorted(wanted.keys() | stored.keys()):
        ours, theirs = (_describe(arrays.get(name)) for arrays in (wanted, stored))
        if ours != theirs:
            raise ValueError(f"{name} is {theirs}, and should be {ours}")


def _reason(error: Exception) -> str:
    """Return why, in one line of at most 305 characters, without places in another's source."""
    text = _PLACES.sub("", str(error))
    lines = text.strip().splitlines() or [type(error).__name__]
    # What TensorStore says begins with what it did, and ends with why it failed.
    return lines[0] if len(lines[0]) <= 300 else f"{lines[0][:150]} ... {lines[0][-150:]}"


def _describe(array: Any) -> str:
    if array is None:
        return "missing"
    dtype = getattr(array.dtype, "numpy_dtype", array.dtype)
    return f"{np.dtype(dtype)}{list(array.shape)}"


def _this_process_alone() -> Any:
    """Orbax would wait for the other processes of a training, which do not write."""
    me = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process-{me}"
    )


def _step_names() -> ocp.path.step.NameFormat[Any]:
    return ocp.path.step.standard_name_format(step_format_fixed_length=_STEP_DIGITS)
