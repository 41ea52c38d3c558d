"""Provide what all commands share: arguments and their types, one-line errors, exit codes.

The exit codes are: 0 success · 1 finished, but below the requested `--min-success`, a plan that
does not fit, or what `docs/stop-and-resume.md` lists of other commands · 2 an error that the user
can correct · 75 a training that was asked to stop, is saved, and continues with the same command ·
130 interrupted.

A command module imports only this module at its top, and the rest in `main`, after it has parsed
its arguments: a mistyped command answers before JAX, MuJoCo or NumPy is imported. For the same
reason this module imports them only where it uses them.
"""

import argparse
import contextlib
import difflib
import functools
import os
import re
import shlex
import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeVar

from jetbot_mjx import errors, startup
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import parse_goals
from jetbot_mjx.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from jetbot_mjx.config import Config

PROGRAM = "jetbot-mjx"
"""Name of the console script, with which every command's usage begins."""

USER_ERROR = 2
_BUG = 1

_BY_POSITION = "config_by_position"
"""Attribute of the parsed arguments with the `CONFIG` that no `--config` precedes."""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line, with a likely remedy."""

    def __init__(self, **options: Any) -> None:
        """Create a parser that takes the names of options in full, so that a typo is told."""
        super().__init__(**options, allow_abbrev=False)

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
                taken = {one.metavar for one in self._actions} & _LISTS.keys() or _LISTS
                hint = " and ".join(text for metavar, text in _LISTS.items() if metavar in taken)
                self.error(f"unrecognized arguments: {name}: {hint}")
            if name.startswith("--") and name not in options and name != "--":
                self.error(f"unrecognized arguments: {name}{self._remedy(word, name)}")
        self._refuse_bare_settings(words)
        parsed, extra = self.parse_known_args(words, namespace)
        assert parsed is not None
        if by_position := getattr(parsed, _BY_POSITION, None):
            parsed.config = by_position
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

    def _refuse_bare_settings(self, words: Sequence[str]) -> None:
        """Refuse `KEY=VALUE` after the value of another argument: it would be taken for a file."""
        options = self._option_string_actions
        if "--set" not in options:
            return
        for before, word in zip(["", *words], words, strict=False):
            takes_a_value = before in options and options[before].nargs != 0
            if word[:1] == "-" or "=" not in word or takes_a_value or os.path.exists(word):
                continue
            if remedy := self._remedy(word):
                self.error(f"unrecognized arguments: {word}{remedy}")

    def _remedy(self, word: str, option: str = "") -> str:
        """Return what was probably meant by an unknown argument, or nothing.

        Args:
          word: the argument, perhaps with a value, such as `num_envs=128` or `--num_envs`.
          option: the name of the argument if it is an option, such as `--num_envs`.
        """
        # Nobody shall be told by a mistake in spelling to run the code of others.
        known = self._option_string_actions.keys() - {"--trust"}
        close = difflib.get_close_matches(option, sorted(known), n=1, cutoff=0.65)
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
        message = errors.printable(" ".join(message.splitlines()))
        if hint := _LISTS.get(message.removeprefix("the following arguments are required: ")):
            message += f": {hint}"
        self.exit(USER_ERROR, f"{self.prog}: error: {message} (--help lists the arguments)\n")


_LISTS = {
    "CONFIG": f"`{PROGRAM} configs` lists the configurations",
    "RUN": f"`{PROGRAM} runs` lists the runs, and latest is the newest",
}
"""The command that lists the possible values of an argument, by the name of the value."""


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
    if first in ("--config", "--resume", "--set"):
        return f"train {shlex.join(words)}"
    if first.startswith("-"):
        return _OTHER_COMMANDS.get(first, "")
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
    "--list": "configs or runs",
}
"""The commands by the names that other programs use; these are suggested, and not accepted."""


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
        everything it opens. Ctrl-C does not wait for a compiler either.
      writes_files: whether the results are in files, so that the command has succeeded even if its
        output could not be written.
    """
    startup.protect_output()
    startup.keep_own_files()
    startup.share_memory()
    # Run the command and convert known errors to an exit code.
    try:
        startup.collect_garbage_late()
        startup.set_environment()
        startup.install_lazy_imports()
        startup.repeat_interrupts()
        if at_once:
            startup.exit_if_stuck()
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
        startup.exit_at_once(code)
    sys.exit(code)


def tell(text: str) -> None:
    """Print a result; control characters, as in the name of a file, are printed as escapes.

    Args:
      text: one line or several.
    """
    print(errors.printable_lines(text), flush=True)


def tell_written(files: Sequence[Path], check: str) -> None:
    """Tell which files were written to start from, and what can be done with the last of them.

    Args:
      files: the files, the configuration last.
      check: the command that checks a configuration.
    """
    config = shlex.quote(str(files[-1]))
    tell(f"wrote {' and '.join(map(str, files))}")
    tell(f"next: {PROGRAM} {check} {config}\n      {PROGRAM} train {config}")


def note(text: str) -> None:
    """Print a line for the user on standard error, where it does not mix with results."""
    print(errors.printable(text), file=sys.stderr, flush=True)


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
        case RuntimeError() if errors.ran_out(error):
            print(
                "error: the device's memory is too small: choose a smaller --episodes",
                file=sys.stderr,
            )
            return USER_ERROR
        case RuntimeError() if reason := errors.lost_device(error):
            print(f"error: the device failed: {errors.printable(reason)}", file=sys.stderr)
            return USER_ERROR
        case OSError() if reason := errors.unanswered(error):
            line = f"{errors.printable(reason)}: the drive does not answer"
            print(f"error: {line}: give the same command again when it does", file=sys.stderr)
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
    error = errors.write_error(sys.stdout)
    if error is None or error.errno in errors.READER_LEFT:
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
    from jetbot_mjx.devices import require_device

    require_device()
    startup.enable_jax_cache()


def show_progress() -> contextlib.AbstractContextManager[None]:
    """Show the progress inside the context on standard error, where it does not mix with results.

    The commands that take more than two seconds use it.
    """
    from jetbot_mjx.terminal import show_progress

    return show_progress(sys.stderr)


_LARGEST = 2**31 - 1
_Number = TypeVar("_Number", int, float)


def number(kind: type[_Number], least: float, most: float = _LARGEST) -> Callable[[str], _Number]:
    """Return an argument type for numbers within bounds.

    Args:
      kind: `int` or `float`.
      least: the smallest accepted value.
      most: the largest accepted value.

    Returns:
      A function to pass as `type` to an argument parser.
    """

    def parse(text: str) -> _Number:
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
fraction = number(float, 0, 1)


def add_count(
    parser: argparse._ActionsContainer,
    name: str,
    text: str,
    *,
    least: int = 1,
    most: int = _LARGEST,
    default: int | None = None,
) -> None:
    """Add an option that takes a whole number.

    Args:
      parser: the parser of the command, or a group of its arguments.
      name: the name of the option.
      text: the help, to which a default is added.
      least: the smallest accepted value.
      most: the largest accepted value.
      default: the value where the option is absent; None: the help says what that means.
    """
    shown = "" if default is None else f" (default: {default:,})"
    kind = whole_number(least, most)
    parser.add_argument(name, type=kind, default=default, metavar="N", help=text + shown)


def add_flag(parser: argparse.ArgumentParser, name: str, text: str) -> None:
    """Add an option without a value, with a name and a help."""
    parser.add_argument(name, action="store_true", help=text)


def add_choice(
    parser: argparse.ArgumentParser, name: str, choices: Sequence[str], text: str
) -> None:
    """Add an option that takes one of several words, by default the first; the help says so."""
    text = f"{text} (default: {choices[0]})"
    parser.add_argument(name, choices=choices, default=choices[0], help=text)


def add_output(parser: argparse.ArgumentParser, text: str, default: Path | None = None) -> None:
    """Add the option `--output`, which names a folder.

    Args:
      parser: the parser of the command.
      text: the help.
      default: the folder where the option is absent; None: the help says what that means.
    """
    parser.add_argument("--output", type=Path, default=default, metavar="DIR", help=text)


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


def size(text: str) -> tuple[int, int]:
    """Parse an argument that is the width and height of a video."""
    found = re.fullmatch(r"([0-9]{1,9})x([0-9]{1,9})", text)
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size: write it as in 1280x720")
    sides = (int(found[1]), int(found[2]))
    try:
        errors.check_size(sides)
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return sides


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


def write_page(
    run: Path, output: Path | None, which: Literal["best", "last"] | int, *, trust: bool
) -> Path:
    """Write the page of a run, and tell what is in it.

    Args:
      run: the run, or one of its checkpoints.
      output: the file to write; None: one in the run folder.
      which: the checkpoint of a run.
      trust: whether to run the code that the run names, whoever wrote it.

    Returns:
      The file.
    """
    with startup.exit_on_interrupt():
        from jetbot_mjx.deployment import summarize_web_page, write_web_page
    prepare_device()
    with trusting(trust), show_progress():
        page = write_web_page(run, output, which=which)
    tell(summarize_web_page(page))
    return page.path


def open_page(path: Path) -> None:
    """Open a file in the browser, or print that there is none."""
    import webbrowser

    if not webbrowser.open(path.resolve().as_uri()):
        tell("no browser was found: open this file in one")


def find_policy(name: str, what: Literal["checkpoint", "run"] = "checkpoint") -> Path:
    """Return the path of the run or checkpoint that an argument names, after all are parsed.

    Call it before importing what uses the policy: a wrong name is then reported at once.

    Args:
      name: the argument.
      what: what the error calls the thing that is missing.

    Raises:
      NotFoundError: as for `runs.find_run`, or there is no folder at the path.
      UserError: the path cannot be looked up.
    """
    with startup.exit_on_interrupt():
        from jetbot_mjx.runs import explain_missing, find_run
    path = find_run(name, say=note)
    missing = f"no {what} at {path.absolute()}"
    with errors.os_errors(missing):
        reason = explain_missing(path.absolute())
    if reason:
        raise errors.NotFoundError(f"{missing}: {reason}")
    return path


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
        "a run folder or one checkpoint folder of it; or latest, the name of a folder in runs/,"
        " pretrained:NAME, or hf:USER/NAME"
    )
    nargs = None
    if several:
        nargs, what = "+", f"{what}; several are compared"
    elif default is not None:
        nargs, what = "?", f"{what} (default: {default})"
    parser.add_argument("run", nargs=nargs, metavar="RUN", help=what)
    parser.add_argument(
        "--checkpoint",
        dest="which",
        type=which_checkpoint,
        default="best",
        metavar="best|last|STEPS",
        help="which checkpoint of a run folder (default: best)",
    )
    add_trust(parser)


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Add the option `--trust`."""
    text = (
        "run the code that the run names, also if no training of yours on this machine has run it"
    )
    add_flag(parser, "--trust", text)


def trusting(asked: bool) -> contextlib.AbstractContextManager[None]:
    """Run the code that runs name inside the context, whoever wrote it, if `--trust` was given."""
    from jetbot_mjx.runs import trusting

    return trusting(asked)


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
        group.add_argument(_BY_POSITION, type=Path, nargs="?", metavar="CONFIG", help=text)
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
