"""List the commands, or run one: `python -m jetbot_mjx`, `jetbot-mjx train --config FILE`."""

import ast
import difflib
import re
import runpy
import sys
from collections.abc import Sequence
from importlib import resources

from jetbot_mjx import __version__

COMMANDS = (
    "pretrained",
    "train",
    "plan",
    "evaluate",
    "render",
    "play",
    "export",
    "sim2real",
    "replay",
    "new_task",
    "check_env",
)
"""Names of the commands, in the order in which a user needs them."""

_ALONE = "python -m jetbot_mjx"
_WHAT_AND_HOW = re.compile(r"(?P<what>.+?): `(?P<how>python -m jetbot_mjx\.[^`]+)`")


def run() -> dict[str, str]:
    """Return the description of each command from its module's first line, without importing it.

    Returns:
      The descriptions by command line, in the order of `COMMANDS`.
    """
    found = {}
    for name in COMMANDS:
        source = resources.files("jetbot_mjx").joinpath(f"{name}.py").read_text("utf-8")
        told = _WHAT_AND_HOW.match(ast.get_docstring(ast.parse(source)) or "")
        assert told is not None, name
        found[told["how"]] = told["what"]
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the given command, or print the list of commands.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0, or 2 if there is no such command. A command that runs ends the process with its own code.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words and words[0] in COMMANDS:
        # Behave like `python -m jetbot_mjx.COMMAND`, including the exit code.
        sys.argv[1:] = words[1:]
        runpy.run_module(f"jetbot_mjx.{words[0]}", run_name="__main__", alter_sys=True)
    if words == ["--version"]:
        print(f"jetbot_mjx {__version__}")
        return 0
    if words and words not in (["-h"], ["--help"]):
        close = difflib.get_close_matches(words[0], COMMANDS, n=1)
        remedy = f"did you mean {close[0]}?" if close else f"say {_ALONE} for a list"
        print(f"error: {_ALONE} {words[0]}: there is no such command: {remedy}", file=sys.stderr)
        return 2
    listed = run()
    width = max(map(len, listed))
    print("Each tells of its arguments with --help:")
    for how, what in listed.items():
        print(f"  {how:{width}}  {what[0].lower()}{what[1:]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
