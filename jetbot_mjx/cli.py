"""Provide what all commands share: arguments and their types, one-line errors, exit codes.

The exit codes are: 0 success · 1 finished, but below the requested `--min-success`, or a plan that
does not fit · 2 an error that the user can correct · 75 a training that was asked to stop, is
saved, and continues with the same command · 130 interrupted.

A command module imports only this module at its top, and the rest in `main`, after it has parsed
its arguments: a mistyped command answers before JAX, MuJoCo or NumPy is imported. For the same
reason this module imports them only where it uses them.
"""

import argparse
import contextlib
import ctypes
import difflib
import functools
import gc
import os
import shlex
import sys
import threading
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

from jetbot_mjx.errors import UserError, printable, printable_lines, ran_out
from jetbot_mjx.evaluation.goal_set import parse_goals
from jetbot_mjx.imports import install_lazy_imports
from jetbot_mjx.interrupts import (
    INTERRUPTED,
    exit_if_interrupt_waits,
    exit_on_interrupt,
    repeat_lost_interrupts,
)
from jetbot_mjx.runs.output import READER_LEFT, protect_output, write_error

if TYPE_CHECKING:
    from jetbot_mjx.config import Config

PROGRAM = "jetbot-mjx"
"""Name of the console script, with which every command's usage begins."""

USER_ERROR = 2
_BUG = 1

_GARBAGE_THRESHOLDS = 1_000_000, 50, 100
"""Thresholds of Python's garbage collector during the start of a command. With its own, which begin
at 700 objects, it takes a third of the time that imports and JAX's tracing take, and finds nothing.
A start that finds its programs compiled makes fewer objects than the first of these.
"""

_START_SECONDS = 60
"""Time after which the collector works as usual, for commands that run for long [s]."""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line, with a likely remedy."""

    def parse_args(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Parse all arguments, and suggest an option for one that is unknown."""
        # Before the rest, because the value after an unknown option looks like another argument.
        words = list(sys.argv[1:] if args is None else args)
        options = self._option_string_actions
        for word in words:
            name = word.partition("=")[0]
            if name == "--list":
                self.error(
                    f"unrecognized arguments: {name}: `{PROGRAM} configs` lists the configurations,"
                    f" and `{PROGRAM} runs` the runs"
                )
            if name.startswith("--") and not any(one.startswith(name) for one in options):
                self.error(f"unrecognized arguments: {name}{self._remedy(word, name)}")
        parsed, extra = self.parse_known_args(words, namespace)
        assert parsed is not None
        if extra:
            remedy = self._remedy(extra[0])
            half = [one for one in getattr(parsed, "overrides", []) if "=" not in one]
            positionals = [one.metavar for one in self._get_positional_actions()]
            if half:
                remedy = f": did you mean --set {half[-1]}={extra[0]}?"
            elif not remedy and positionals and extra[0][:1] != "-":
                remedy = f": give only one {positionals[0]}"
            self.error(f"unrecognized arguments: {' '.join(extra)}{remedy}")
        return parsed

    def _remedy(self, word: str, option: str = "") -> str:
        """Return what was probably meant by an unknown argument, or nothing.

        Args:
          word: the argument, perhaps with a value, such as `num_envs=128` or `--num_envs`.
          option: the name of the argument if it is an option, such as `--num_envs`.
        """
        close = difflib.get_close_matches(option, self._option_string_actions, n=1, cutoff=0.65)
        if "--set" in self._option_string_actions:
            # Only to explain an error: it takes longer than the rest of the parser.
            from jetbot_mjx.config import keys_meant_by

            setting, _, value = word.strip("-").partition("=")
            meant = keys_meant_by(setting.replace("-", "_"), similar=not close)
            option_of = {"seed": "--seed", "seeds": "--seeds"}
            if meant and option_of.get(meant[0]) in self._option_string_actions:
                close = [f"{option_of[meant[0]]} {value or '...'}"]
            elif meant:
                close = [f"--set {meant[0]}={value or '...'}"]
        return f": did you mean {close[0]}?" if close else ""

    def error(self, message: str) -> NoReturn:
        """Print the error in one line and exit with code 2."""
        message = printable(" ".join(message.splitlines()))
        self.exit(USER_ERROR, f"{self.prog}: error: {message} (--help lists the arguments)\n")


def command_meant_by(words: Sequence[str], commands: Collection[str]) -> str:
    """Return what was probably meant by words that begin with no command, or nothing.

    Args:
      words: what was typed after the program's name.
      commands: the names of all commands.
    """
    # Only to explain an error: it takes longer than the list of commands.
    from jetbot_mjx.config import run_around, shipped_configs

    first, path = words[0], Path(words[0])
    if first in ("help", "-h", "--help"):
        return f"{words[1]} --help" if words[1:] and words[1] in commands else "--help"
    if first.startswith("-"):
        return f"train {shlex.join(words)}" if first in ("--config", "--resume", "--set") else ""
    if path.stem in shipped_configs() or (path.suffix == ".yaml" and os.path.isfile(path)):
        return f"train {shlex.quote(first)}"
    if run_around(path):
        return f"evaluate {shlex.quote(first)}"
    close = difflib.get_close_matches(first, commands, n=1)
    return _OTHER_COMMANDS.get(first) or (close[0] if close else "")


_OTHER_COMMANDS = {
    **dict.fromkeys(("enjoy", "watch", "view", "viewer", "visualize"), "play"),
    **dict.fromkeys(("test", "eval", "compare", "report"), "evaluate"),
    **dict.fromkeys(("video", "record"), "render"),
    **dict.fromkeys(("list", "ls"), "runs"),
    **dict.fromkeys(("sweep", "search", "optimize"), "tune"),
    "new": "new-task",
    "resume": "train --resume RUN",
}
"""What other programs call a command; it is suggested, and not accepted."""


def run_command(
    command: Callable[[Sequence[str] | None], int],
    *,
    at_once: bool = False,
    writes_files: bool = False,
) -> NoReturn:
    """Run a command's `main` and exit the process.

    Args:
      command: a function that takes the arguments and returns the exit code.
      at_once: whether to exit without Python's clean-up, for a command that computes and closes
        everything it opens: JAX takes a second to release a GPU, and a compiler's thread, which
        cannot be interrupted, may abort the process. Ctrl-C does not wait for a compiler either.
      writes_files: whether the results are in files, so that the command has succeeded even if its
        output could not be written.
    """
    # Prepare the process: its memory, its threads, its output, its imports and its signals.
    usual = gc.get_threshold()
    gc.set_threshold(*_GARBAGE_THRESHOLDS)
    timer = threading.Timer(_START_SECONDS, gc.set_threshold, usual)
    timer.daemon = True
    timer.start()
    # JAX computes. NumPy would start a thread for every core, which takes longer than its import.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Pydantic would look for plugins in all installed packages.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    protect_output()
    install_lazy_imports()
    repeat_lost_interrupts()
    if at_once:
        exit_if_interrupt_waits()
    # Run the command and convert known errors to an exit code.
    try:
        code = command(None)
    except BaseException as error:
        code = _report_error(error)
        if code is None:
            if not at_once:
                raise
            sys.excepthook(type(error), error, error.__traceback__)
            code = _BUG
        # It has ended early, for example after its help.
        writes_files = False
    # Exit.
    code = _report_lost_output(code, writes_files=writes_files)
    if at_once:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def tell(text: str) -> None:
    """Print a result, which may name files: a terminal shows all of its characters and obeys none.

    Args:
      text: one line or several.
    """
    print(printable_lines(text), flush=True)


def _report_error(error: BaseException) -> int | None:
    """Print the line about an error that is no bug, and return its exit code; None if it is one."""
    match error:
        case SystemExit(code=None):
            return 0
        case SystemExit(code=int(code)):
            # `argparse` has printed what is wrong, or the help.
            return code
        case UserError():
            print(f"error: {error}", file=sys.stderr)
            return USER_ERROR
        # JAX raises a subclass, which is not named here because that would import JAX.
        case RuntimeError() if ran_out(error):
            print(
                "error: the device's memory is too small: choose a smaller --episodes",
                file=sys.stderr,
            )
            return USER_ERROR
        case KeyboardInterrupt():
            print("interrupted", file=sys.stderr)
            return INTERRUPTED
        case _:
            return None


def _report_lost_output(code: int, *, writes_files: bool) -> int:
    """Print a line if standard output could not be written, and return the exit code.

    A reader that leaves, such as `head`, has read what it wanted.
    """
    sys.stdout.flush()
    error = write_error(sys.stdout)
    if error is None or error.errno in READER_LEFT:
        return code
    failed = not (code or writes_files)
    kind = "error" if failed else "warning"
    print(f"{kind}: standard output cannot be written: {error.strerror}", file=sys.stderr)
    return USER_ERROR if failed else code


def prepare_device() -> None:
    """Check that JAX has a usable device, and turn its compilation cache on.

    Raises:
      UserError: as for `require_device`.
    """
    from jetbot_mjx.compiler.program_cache import use_compilation_cache

    require_device()
    use_compilation_cache()


def show_progress() -> contextlib.AbstractContextManager[None]:
    """Show the progress inside the context on standard error, where it does not mix with results.

    The commands that take more than two seconds use it.
    """
    from jetbot_mjx.runs import progress

    return progress.show_progress(sys.stderr)


def require_device() -> None:
    """Raise an error if JAX has no usable device.

    Raises:
      UserError: `JAX_PLATFORMS` names a missing platform, or JAX is set to 64 bits.
    """
    import jax

    from jetbot_mjx.compiler.backends import require_float32

    require_float32()
    try:
        jax.devices()
    # JAX fails by an assertion where the plugin for a platform is not installed.
    except (RuntimeError, AssertionError):
        wanted = os.environ.get("JAX_PLATFORMS")
        raise UserError(
            f"JAX_PLATFORMS = {wanted!r} cannot be used here: unset it, or install what it needs"
        ) from None


def divide_cpu(devices: int | None) -> None:
    """Divide the CPU into devices, if JAX has not begun yet; a training refuses another number.

    Args:
      devices: the setting `cpu_devices`; None: leave it to JAX.
    """
    import jax

    if devices is not None:
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", devices)


def wake_driver() -> None:
    """Start to open NVIDIA's driver in a thread, if there is one, while the host imports JAX.

    JAX opens it later, and holds Python's lock meanwhile: on an H200 for a fifth of a second.
    """

    def open_driver() -> None:
        # JAX reports what is wrong with the driver.
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL("libcuda.so.1").cuInit(0)

    platforms = os.environ.get("JAX_PLATFORMS")
    if not platforms or {"cuda", "gpu"} & set(platforms.split(",")):
        threading.Thread(target=open_driver, daemon=True).start()


def wake_device() -> None:
    """Start to initialise the device in a thread, while the host continues.

    JAX then allocates GPU memory as needed, unless `XLA_PYTHON_CLIENT_PREALLOCATE` requests its
    default of allocating three quarters at once, which takes two seconds and leaves little memory
    for other processes.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax

    def touch() -> None:
        # The first code that needs the device will report the error.
        with contextlib.suppress(RuntimeError, AssertionError):
            jax.block_until_ready(jax.device_put(0.0, jax.local_devices()[0]))

    threading.Thread(target=touch, daemon=True).start()


_LARGEST = 2**31 - 1


def number(kind: type, least: float, most: float = _LARGEST) -> Callable[[str], Any]:
    """Return an argument type for numbers within bounds.

    Args:
      kind: `int` or `float`.
      least: the smallest accepted value.
      most: the largest accepted value.

    Returns:
      A function to pass as `type` to an argument parser.
    """

    def parse(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            what = "whole number" if kind is int else "number"
            raise argparse.ArgumentTypeError(f"{text!r} is not a {what}") from None
        # A comparison with NaN is false.
        if not value >= least:
            raise argparse.ArgumentTypeError(f"{text} is too small: give at least {least}")
        if value > most:
            raise argparse.ArgumentTypeError(f"{text} is too large: give at most {most}")
        return value

    return parse


whole_number = functools.partial(number, int)
positive_int = whole_number(1)
seed = whole_number(0, 2**32 - 1)
fraction = number(float, 0, 1)


def which_checkpoint(text: str) -> Literal["best", "last"] | int:
    """Parse an argument that names a checkpoint of a run."""
    if text == "best" or text == "last":
        return text
    # Limit the digits, because Python raises an error for integers with too many of them.
    if text.isdecimal() and len(text) < 100:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is neither best, last nor a number of steps")


def goals(text: str) -> list[int]:
    """Parse an argument that lists fixed goals."""
    try:
        return parse_goals(text)
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def origin(text: str) -> str:
    """Parse an argument that is a page's origin, as browsers write it."""
    import urllib.parse

    try:
        parts = urllib.parse.urlsplit(text.lower())
        port, name = parts.port, parts.hostname
    except ValueError:
        port = name = None
    else:
        if parts.path not in ("", "/") or parts.query or parts.fragment or parts.username:
            name = None
    if not name or parts.scheme not in ("http", "https"):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an origin: write it as https://hub.example.org or http://localhost:3000"
        )
    default = {"http": 80, "https": 443}[parts.scheme]
    host = f"[{name}]" if ":" in name else name
    return f"{parts.scheme}://{host}" + ("" if port in (None, default) else f":{port}")


def find_run(name: str) -> Path:
    """Return the path of the run or checkpoint that an argument names, after all are parsed.

    Raises:
      NotFoundError: as for `runs.find_run`.
    """
    with exit_on_interrupt():
        from jetbot_mjx.runs import find_run

    return find_run.find_run(name)


def add_checkpoint_arguments(
    parser: argparse.ArgumentParser, *, several: bool = False, default: str | None = None
) -> None:
    """Add the arguments `run` and `--checkpoint`, which select a policy.

    Args:
      parser: the parser of the command.
      several: whether the command accepts more than one run; `run` is then a list.
      default: description of the policy that is used if no run is given; `run` is then None. None:
        a run must be given.
    """
    what = (
        "a run folder or one checkpoint folder of it; or latest, the name of a folder in runs/, or"
        " pretrained:NAME"
    )
    nargs = None
    if several:
        nargs, what = "+", f"{what}; several are compared"
    elif default is not None:
        nargs, what = "?", f"{what} (default: {default})"
    parser.add_argument("run", nargs=nargs, metavar="RUN", help=what)
    parser.add_argument(
        "--checkpoint",
        type=which_checkpoint,
        default="best",
        metavar="best|last|STEPS",
        help="which checkpoint of a run folder (default: best)",
    )


class _KeepIfAbsent(argparse.Action):
    """An action of a positional argument that may be absent: another one may have set its value."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        """Store the value if there is one."""
        if values is not None:
            setattr(namespace, self.dest, values)


def add_config_arguments(
    parser: argparse.ArgumentParser,
    group: "argparse._MutuallyExclusiveGroup | None" = None,
    *,
    positional: bool = True,
) -> None:
    """Add the arguments `CONFIG`, `--config` and `--set`, which select a configuration.

    Args:
      parser: The parser of the command.
      group: The mutually exclusive group that both belong to, or None for one of their own.
      positional: Whether the name alone is accepted, without `--config` before it.
    """
    group = group or parser.add_mutually_exclusive_group()
    text = f"name of a configuration (`{PROGRAM} configs` lists them) or YAML file"
    same = "the configuration, in place of CONFIG"
    group.add_argument("--config", type=Path, metavar="CONFIG", help=same if positional else text)
    if positional:
        group.add_argument(
            "config", type=Path, nargs="?", action=_KeepIfAbsent, metavar="CONFIG", help=text
        )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override one setting; may be repeated",
    )


def require_config(parser: Parser, options: argparse.Namespace) -> None:
    """Exit with an error if no configuration is named."""
    if options.config is None:
        parser.error(f"name a configuration, as in `{parser.prog} jetbot`")


def config_of(options: argparse.Namespace, *overrides: str) -> "Config":
    """Return the configuration that `--config` and `--set` select.

    Args:
      options: The parsed arguments.
      overrides: Further overrides, which take precedence over `--set`.

    Returns:
      The checked configuration.

    Raises:
      UserError: the file cannot be read, or a setting is invalid.
    """
    from jetbot_mjx.config import load_config

    return load_config(options.config, [*options.overrides, *overrides])
