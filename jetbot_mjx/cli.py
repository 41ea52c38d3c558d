"""What the commands share: one line for a user's mistake, and exit codes that mean something.

0 done · 1 done, and below what was asked for (`--min-success`), or a plan that does not fit ·
2 the user can mend it · 75 a training was asked to stop, is saved, and goes on by the same
command · 130 interrupted.
"""

import argparse
import contextlib
import io
import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Literal, NoReturn

import jax

from jetbot_mjx.errors import UserError, ran_out
from jetbot_mjx.interrupts import raise_again

USER_ERROR = 2
INTERRUPTED = 130


class Parser(argparse.ArgumentParser):
    """An argument parser that states a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        """Prints the line and exits with 2."""
        message = " ".join(message.splitlines())
        self.exit(USER_ERROR, f"{self.prog}: error: {message} (--help lists the arguments)\n")


def run_command(
    command: Callable[[Sequence[str] | None], int], *, at_once: bool = False
) -> NoReturn:
    """Runs a command's `main` and exits.

    Args:
      command: takes the arguments and returns the exit code.
      at_once: whether to leave the rest to the system, for a command that has closed all that it
        opened: JAX takes a second to give a GPU back, and a compiler's thread, which cannot be
        interrupted, may abort the process.
    """
    for stream in (sys.stdout, sys.stderr):
        # What a terminal has no letters for must not end a command that has done its work.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    raise_again()
    try:
        code = command(None)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        code = USER_ERROR
    except jax.errors.JaxRuntimeError as error:
        if not ran_out(error):
            raise
        print(
            "error: the device's memory does not suffice: choose a smaller --episodes",
            file=sys.stderr,
        )
        code = USER_ERROR
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = INTERRUPTED
    except BrokenPipeError:
        # Whoever read our output has gone: nothing is left to say.
        sys.stderr.close()
        code = USER_ERROR
    if at_once:
        with contextlib.suppress(BrokenPipeError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def require_device() -> None:
    """Refuses to go on where JAX has no device to run on.

    Raises:
      UserError: `JAX_PLATFORMS` names what is not there, or JAX computes in 64 bits.
    """
    if jax.config.values["jax_enable_x64"]:
        raise UserError("all is computed in float32, and JAX_ENABLE_X64 is set: unset it")
    try:
        jax.devices()
    # JAX fails by an assertion where the plugin for a platform is not installed.
    except (RuntimeError, AssertionError):
        wanted = os.environ.get("JAX_PLATFORMS")
        raise UserError(
            f"JAX_PLATFORMS = {wanted!r} cannot be used here: unset it, or install what it needs"
        ) from None


def wake_device() -> None:
    """Lets a GPU make itself ready while the host does something else.

    It takes memory as it needs it, unless `XLA_PYTHON_CLIENT_PREALLOCATE` asks for JAX's habit of
    taking three quarters of it at once: that lasts two seconds, and leaves others none.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

    def touch() -> None:
        # Whoever needs the device hears of what is wrong with it.
        with contextlib.suppress(RuntimeError, AssertionError):
            jax.block_until_ready(jax.device_put(0.0, jax.local_devices()[0]))

    threading.Thread(target=touch, daemon=True).start()


_LARGEST = 2**31 - 1


def whole_number(least: int, most: int = _LARGEST) -> Callable[[str], int]:
    """An argument that counts or numbers something.

    Args:
      least: the smallest that is taken.
      most: the largest that is taken.

    Returns:
      What an argument parser calls a type.
    """

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
        if value < least:
            raise argparse.ArgumentTypeError(f"{value} is too small: give at least {least}")
        if value > most:
            raise argparse.ArgumentTypeError(f"{value} is too large: give at most {most}")
        return value

    return parse


positive_int = whole_number(1)


def fraction(text: str) -> float:
    """An argument between 0 and 1."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 1")
    return value


def positive_float(text: str) -> float:
    """An argument above 0."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not 0 < value <= _LARGEST:
        raise argparse.ArgumentTypeError(f"{text} is not above 0 and at most {_LARGEST}")
    return value


def which_checkpoint(text: str) -> Literal["best", "last"] | int:
    """An argument that names a checkpoint of a run."""
    if text == "best":
        return "best"
    if text == "last":
        return "last"
    # More digits than any number of steps has, Python would refuse to read.
    if text.isdecimal() and len(text) < 100:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is neither best, last nor a number of steps")


def add_checkpoint_arguments(
    parser: argparse.ArgumentParser, *, several: bool = False, default: str | None = None
) -> None:
    """Adds `run` and `--checkpoint`, by which a command finds its policy.

    Args:
      parser: of the command.
      several: whether it takes more than one run; `run` is then a list.
      default: what is taken where no run is named, in words; `run` is then None. None: one has to
        be named.
    """
    what = "a run folder, or one checkpoint folder of it"
    if several:
        parser.add_argument("run", nargs="+", help=f"{what}; several are compared")
    elif default is not None:
        parser.add_argument("run", nargs="?", help=f"{what} (default: {default})")
    else:
        parser.add_argument("run", help=what)
    parser.add_argument(
        "--checkpoint",
        type=which_checkpoint,
        default="best",
        metavar="best|last|STEPS",
        help="which checkpoint of a run folder (default: best)",
    )
