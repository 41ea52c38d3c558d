"""What the commands share: one line for a user's mistake, and exit codes that mean something.

0 done · 1 done, and below what was asked for (`--min-success`) · 2 the user can mend it ·
130 interrupted.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

import jax

from jetbot_mjx.checkpoint import Which
from jetbot_mjx.errors import UserError

USER_ERROR = 2
INTERRUPTED = 130


class Parser(argparse.ArgumentParser):
    """An argument parser that states a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        """Prints the line and exits with 2."""
        message = " ".join(message.splitlines())
        self.exit(USER_ERROR, f"{self.prog}: error: {message} (--help lists the arguments)\n")


def run_command(command: Callable[[Sequence[str] | None], int]) -> NoReturn:
    """Runs a command's `main` and exits.

    Args:
      command: takes the arguments and returns the exit code.
    """
    try:
        code = command(None)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        code = USER_ERROR
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        print(
            "error: the device's memory does not suffice: choose a smaller ppo.num_envs,"
            " evaluation.episodes or --episodes",
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
    sys.exit(code)


def require_device() -> None:
    """Refuses to go on where JAX has no device to run on.

    Raises:
      UserError: `JAX_PLATFORMS` names what is not there.
    """
    try:
        jax.devices()
    # JAX fails by an assertion where the plugin for a platform is not installed.
    except (RuntimeError, AssertionError):
        wanted = os.environ.get("JAX_PLATFORMS")
        raise UserError(
            f"JAX_PLATFORMS = {wanted!r} cannot be used here: unset it, or install what it needs"
        ) from None


_LARGEST = 2**31 - 1


def positive_int(text: str) -> int:
    """An argument that counts something."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is too small: give at least 1")
    if value > _LARGEST:
        raise argparse.ArgumentTypeError(f"{value} is too large: give at most {_LARGEST}")
    return value


def fraction(text: str) -> float:
    """An argument between 0 and 1."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 1")
    return value


def which_checkpoint(text: str) -> Which:
    """An argument that names a checkpoint of a run."""
    if text == "best":
        return "best"
    if text == "last":
        return "last"
    if text.isdecimal():
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is neither best, last nor a number of steps")


def add_checkpoint_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds `run` and `--checkpoint`, by which a command finds its policy."""
    parser.add_argument("run", help="a run folder, or one checkpoint folder of it")
    parser.add_argument(
        "--checkpoint",
        type=which_checkpoint,
        default="best",
        metavar="best|last|STEPS",
        help="which checkpoint of a run folder (default: best)",
    )
