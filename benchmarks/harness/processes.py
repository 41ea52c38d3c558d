"""Run a command of the package, or a function, in a process of its own."""

import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from jetbot_mjx.errors import UserError

T = TypeVar("T")


def run_module(
    module: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None
) -> str:
    """Run `python -m jetbot_mjx.<module>` and return what it printed.

    Args:
      module: The module, for example `train`.
      arguments: Its command-line arguments.
      environment: The environment variables; None: those of this process.

    Raises:
      UserError: The process failed.
    """
    done = subprocess.run(
        [sys.executable, "-m", f"jetbot_mjx.{module}", *arguments],
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no error message"]
        raise UserError(f"{module} failed: {lines[-1]}")
    return done.stdout


def last_within(
    limit: float, function: Callable[..., Iterable[T]], *arguments: Any
) -> tuple[T | None, bool]:
    """Return the last thing that a function yields within so many seconds, in its own process.

    The process is killed after this time, whatever it waits for.

    Args:
      limit: the time [s].
      function: a function of a module.
      arguments: its arguments.

    Returns:
      The last thing, or None, and whether the function came to its end.

    Raises:
      UserError: the process failed.
    """
    context, end = multiprocessing.get_context("spawn"), time.monotonic() + limit
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sender, function, *arguments), daemon=True)
    process.start()
    sender.close()
    last, is_complete = None, False
    try:
        while receiver.poll(max(0.0, end - time.monotonic())):
            last = receiver.recv()
    except EOFError:
        process.join()
        is_complete = True
    finally:
        process.kill()
        process.join()
    if is_complete and process.exitcode:
        names = ", ".join(map(str, arguments))
        raise UserError(f"the process of {function.__name__}({names}) failed")
    return last, is_complete


def _send(sender: Connection, function: Callable[..., Iterable[T]], *arguments: Any) -> None:
    for each in function(*arguments):
        sender.send(each)
