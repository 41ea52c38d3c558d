"""Several processes that train one policy together, one for each host or each GPU.

Every process holds the same parameters and steps its share of the environments. The first one
alone writes, prints, judges and films; what the others do next it tells them, so that all make
the same calls in the same order and none waits for one that has left.
"""

import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Int, PyTree

from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError

JOIN_SECONDS = 120
"""How long processes wait for each other at the start [s]."""

_ADDRESS = "JAX_COORDINATOR_ADDRESS"
_COUNT = "JAX_NUM_PROCESSES"
_INDEX = "JAX_PROCESS_ID"
_PART_SECONDS = 10
"""How long a process that leaves waits for those that may not follow [s]."""

_FAILED = -1
_USER_ERROR = 2


def check(config: Config) -> None:
    """Refuse what several processes cannot do.

    Args:
      config: the run.

    Raises:
      UserError: it asks for that.
    """
    if config.trainer == "brax":
        raise UserError("--distributed is not known to trainer = 'brax': take 'resumable'")
    if config.seeds > 1:
        raise UserError(
            f"--distributed trains one policy, not seeds = {config.seeds}: leave one of them out"
        )


def join() -> None:
    """Join the other processes; to be called before JAX is asked for a device.

    Slurm and Open MPI tell JAX who they are; elsewhere three environment variables do:
    `JAX_COORDINATOR_ADDRESS` (`host:port` of the first process), `JAX_NUM_PROCESSES` and
    `JAX_PROCESS_ID`, counted from 0. Where not all come within `JOIN_SECONDS`, the process ends
    with one line.

    Raises:
      UserError: a variable is missing or wrong.
    """
    address, count, index = _whereabouts()
    # JAX would take SIGTERM for itself; `preemption` listens to it.
    jax.config.update("jax_enable_preemption_service", False)
    waiting = threading.Timer(JOIN_SECONDS, _give_up, [address])
    waiting.daemon = True
    waiting.start()
    try:
        # Past its own limit JAX ends the process by a signal and a page of addresses.
        jax.distributed.initialize(address, count, index, initialization_timeout=JOIN_SECONDS + 60)
    # Of what is missing here, and of what Slurm or Open MPI left half said.
    except (ValueError, LookupError) as error:
        raise UserError(
            f"--distributed: neither Slurm nor Open MPI tells where this process belongs ({error}):"
            f" set {_ADDRESS} (host:port of the first process), {_COUNT} and {_INDEX}"
        ) from None
    finally:
        waiting.cancel()


def leave() -> None:
    """Wait until every process has come here, and parts; nothing where there is one alone."""
    jax.distributed.shutdown()


def is_first() -> bool:
    """Return whether this is the process that writes and prints."""
    return jax.process_index() == 0


def all_gather_ints(*values: int) -> Int[np.ndarray, "processes n"]:
    """Tell all processes a few numbers, and hears theirs; every process must call it.

    Args:
      values: of this process.

    Returns:
      Those of each.
    """
    mine = np.array(values, np.int32)
    if jax.process_count() == 1:
        return mine[None]
    return np.asarray(multihost_utils.process_allgather(mine))


def run_on_primary(action: Callable[[], int]) -> int:
    """Let the first process do something, and tells the others what came of it.

    Args:
      action: done by the first process alone; returns no negative number.

    Returns:
      What it returned there, in all processes.

    Raises:
      UserError: in the others, where it failed in the first.
    """
    if jax.process_count() == 1:
        return action()
    if not is_first():
        outcome = int(all_gather_ints(0)[0, 0])
        if outcome == _FAILED:
            raise UserError("process 0 could not go on, and says why; this one leaves with it")
        return outcome
    try:
        outcome = action()
    except BaseException:
        all_gather_ints(_FAILED)
        raise
    all_gather_ints(outcome)
    return outcome


def broadcast_from_primary(trees: Sequence[PyTree], template: PyTree, count: int) -> list[PyTree]:
    """Hand what the first process holds to all, bit by bit.

    Args:
      trees: arrays on the host; only the first process's count.
      template: shapes and dtypes of one tree.
      count: of trees.

    Returns:
      The trees, on every host.
    """
    if jax.process_count() == 1:
        return list(trees)
    shapes, structure = jax.tree.flatten([template] * count)
    sizes = [int(np.prod(x.shape, dtype=int)) * np.dtype(x.dtype).itemsize for x in shapes]
    mine = np.zeros(sum(sizes), np.uint8)
    if is_first():
        leaves = jax.tree.leaves(list(trees))
        mine = np.concatenate([np.ascontiguousarray(x).reshape(-1).view(np.uint8) for x in leaves])
    # As bytes: a sum of floats with zero loses the sign of a zero.
    theirs: Any = multihost_utils.broadcast_one_to_all(mine)
    parts = np.split(np.asarray(theirs), np.cumsum(sizes)[:-1])
    arrays = [
        part.view(np.dtype(x.dtype)).reshape(x.shape) for part, x in zip(parts, shapes, strict=True)
    ]
    return jax.tree.unflatten(structure, arrays)


def _whereabouts() -> tuple[str | None, int | None, int | None]:
    """Return what the environment says; None for what Slurm or Open MPI is to say."""
    address = os.environ.get(_ADDRESS)
    if address is not None:
        host, colon, port = address.rpartition(":")
        if not (host and colon and port.isdecimal() and 0 < int(port) < 65_536):
            raise UserError(f"{_ADDRESS} = {address!r} is wrong: write host:port")
    count, index = _number(_COUNT), _number(_INDEX)
    if (count is None) != (index is None):
        missing = _COUNT if count is None else _INDEX
        raise UserError(f"{missing} is missing: {_COUNT} and {_INDEX} belong together")
    if count is None or index is None:
        return address, None, None
    if count < 1:
        raise UserError(f"{_COUNT} = {count} is wrong: there is at least one process")
    if index >= count:
        raise UserError(
            f"{_INDEX} = {index} is wrong: {count} processes count from 0 to {count - 1}"
        )
    if address is None:
        raise UserError(f"{_ADDRESS} is missing: give host:port of process 0")
    return address, count, index


def _number(name: str) -> int | None:
    text = os.environ.get(name)
    if text is None:
        return None
    if not text.isdecimal():
        raise UserError(f"{name} = {text!r} is wrong: it should be a whole number")
    return int(text)


def _give_up(address: str | None) -> None:
    where = f" at {address}" if address else ""
    print(
        f"error: --distributed: not all processes have met{where} within {JOIN_SECONDS} s: start as"
        f" many as {_COUNT} says, each with its own {_INDEX}, where that address can be reached",
        file=sys.stderr,
        flush=True,
    )
    os._exit(_USER_ERROR)
