"""Train one policy with several processes, one for each host or each GPU.

Every process holds the same parameters and steps its share of the environments. Only the first
process, the primary, evaluates, writes and prints. It broadcasts the outcome, so that all processes
make the same collective calls in the same order, and none waits for a process that has ended.
"""

import os
import pickle
import threading
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Int

from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError
from jetbot_mjx.interrupts import tell

JOIN_SECONDS = 120
"""Longest time that the processes wait for each other at the start [s]."""

_ADDRESS = "JAX_COORDINATOR_ADDRESS"
_COUNT = "JAX_NUM_PROCESSES"
_INDEX = "JAX_PROCESS_ID"
_BLOCK = 4096
"""Bytes are counted in blocks of this size, so that the number of blocks fits into 32 bits."""
_FAILED = -1
_USER_ERROR = 2

_Value = TypeVar("_Value")


def check_processes(config: Config) -> None:
    """Raise an error if several processes cannot train a configuration.

    Args:
      config: the configuration of the run.

    Raises:
      UserError: its trainer or its number of seeds needs a single process.
    """
    if config.trainer == "brax":
        raise UserError("--distributed is not supported by trainer = 'brax': use 'resumable'")
    if config.init_from is not None:
        raise UserError("--distributed cannot begin with another run's policy: remove init_from")
    if config.seeds > 1:
        raise UserError(
            f"--distributed trains one policy, not seeds = {config.seeds}: remove one of them"
        )


def join_processes() -> None:
    """Connect to the other processes, before JAX is asked for a device.

    Under Slurm and Open MPI, JAX finds its place among the processes itself. Elsewhere three
    environment variables give it: `JAX_COORDINATOR_ADDRESS` (`host:port` of the first process),
    `JAX_NUM_PROCESSES` and `JAX_PROCESS_ID`, counted from 0. If not all processes have connected
    after `JOIN_SECONDS`, this process ends with one line.

    Raises:
      UserError: a variable is missing or wrong.
    """
    address, count, index = _read_environment()
    # Keep JAX from handling SIGTERM, which `preemption` handles.
    jax.config.update("jax_enable_preemption_service", False)
    timeout = threading.Timer(JOIN_SECONDS, _exit_unconnected, [address])
    timeout.daemon = True
    timeout.start()
    try:
        # At its own time limit JAX aborts the process and prints a page of addresses.
        jax.distributed.initialize(address, count, index, initialization_timeout=JOIN_SECONDS + 60)
    # JAX raises these for missing variables, also for incomplete ones of Slurm or Open MPI.
    except (ValueError, LookupError) as error:
        raise UserError(
            f"--distributed: neither Slurm nor Open MPI started this process ({error}):"
            f" set {_ADDRESS} (host:port of the first process), {_COUNT} and {_INDEX}"
        ) from None
    finally:
        timeout.cancel()


def leave_processes() -> None:
    """Wait until every process has called this, and disconnect; do nothing in a single process."""
    jax.distributed.shutdown()


def is_primary() -> bool:
    """Return whether this is the first process, which alone writes and prints."""
    return jax.process_index() == 0


def all_gather_ints(*values: int) -> Int[np.ndarray, "processes n"]:
    """Gather a few numbers from all processes; every process must call this.

    Args:
      values: the numbers of this process, each of which fits into 32 bits.

    Returns:
      The numbers of each process.
    """
    local = np.array(values, np.int32)
    if jax.process_count() == 1:
        return local[None]
    return np.asarray(multihost_utils.process_allgather(local))


def run_on_primary(action: Callable[[], int | None]) -> int:
    """Run a function in the first process, and return its result in all processes.

    Args:
      action: the function, which only the first process calls; it returns a number that is not
        negative, or None for 0.

    Returns:
      The function's result.

    Raises:
      UserError: in the other processes, if the function raised an error in the first.
    """
    if jax.process_count() == 1:
        return action() or 0
    if not is_primary():
        outcome = int(all_gather_ints(0)[0, 0])
        if outcome == _FAILED:
            raise UserError("process 0 has failed and prints the reason; this process ends too")
        return outcome
    try:
        outcome = action() or 0
    except BaseException:
        all_gather_ints(_FAILED)
        raise
    all_gather_ints(outcome)
    return outcome


def broadcast_from_primary(source: Callable[[], _Value]) -> _Value:
    """Copy a value of the first process to all processes, bit for bit.

    Args:
      source: a function that returns the value, which only the first process calls. The value
        consists of arrays on the host, and of classes that every process can import.

    Returns:
      The first process's value, on every host.

    Raises:
      UserError: as for `run_on_primary`.
    """
    if jax.process_count() == 1:
        return source()
    content = b""

    def measure() -> int:
        nonlocal content
        content = pickle.dumps(source())
        return -(-len(content) // _BLOCK)

    blocks = run_on_primary(measure)
    # Broadcast bytes: JAX broadcasts by a sum, in which a float loses the sign of a zero.
    local = np.frombuffer(content.ljust(blocks * _BLOCK, b"\0"), np.uint8)
    # What follows the pickled value is ignored.
    return pickle.loads(np.asarray(multihost_utils.broadcast_one_to_all(local)).tobytes())


def _read_environment() -> tuple[str | None, int | None, int | None]:
    """Return the address, number of processes and index that the environment variables give.

    Each is None if it is not set, so that JAX asks Slurm or Open MPI.
    """
    address = os.environ.get(_ADDRESS)
    if address is not None:
        host, colon, port = address.rpartition(":")
        if not (host and colon and port.isdecimal() and 0 < int(port) < 65_536):
            raise UserError(f"{_ADDRESS} = {address!r} is wrong: write host:port")
    count, index = _read_number(_COUNT), _read_number(_INDEX)
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


def _read_number(name: str) -> int | None:
    text = os.environ.get(name)
    if text is None:
        return None
    if not text.isdecimal():
        raise UserError(f"{name} = {text!r} is wrong: it should be a whole number")
    return int(text)


def _exit_unconnected(address: str | None) -> None:
    """End this process with one line, because not all processes have connected."""
    where = f" at {address}" if address else ""
    tell(
        f"error: --distributed: not all processes have connected{where} within {JOIN_SECONDS} s:"
        f" start as many as {_COUNT} says, each with its own {_INDEX}, where that address can be"
        " reached"
    )
    os._exit(_USER_ERROR)
