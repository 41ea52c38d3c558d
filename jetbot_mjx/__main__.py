"""List the commands, or run one: `jetbot-mjx train --config FILE`.

`jetbot-mjx COMMAND`, `python -m jetbot_mjx COMMAND` and `python -m jetbot_mjx.COMMAND` do the same.
A command is imported only if it is chosen, so that the list is printed at once.
"""

import argparse
import runpy
import sys
from collections.abc import Mapping, Sequence

from jetbot_mjx import __version__, cli
from jetbot_mjx.config import shipped_folder

COMMANDS: Mapping[str, tuple[str, str]] = {
    "train": ("train", "train a policy into a run folder"),
    "evaluate": ("evaluate", "evaluate policies on fixed goals, and compare them"),
    "render": ("render", "write videos and plots of a policy that drives"),
    "play": ("play", "watch a policy live in the browser, and interact with it"),
    "configs": ("list_configs", "list the configurations that come with the package"),
    "runs": ("list_runs", "list your runs, and those that come with the package"),
    "new-task": ("new_task", "write a task to start from"),
    "new-env": ("new_env", "write an environment to start from"),
    "check-env": ("check_env", "check a task or an environment before it is trained"),
    "new-robot": ("new_robot", "write a robot to start from"),
    "check-robot": ("check_robot", "check a robot, and tell what a step of it costs"),
    "plan": ("plan", "predict the memory that a training needs"),
    "tune": ("tune", "search for hyperparameters, many trials at once"),
    "export": ("export", "write a policy to files that run without this package"),
    "share": ("share", "upload a run to the Hugging Face Hub for others"),
    "sim2real": ("sim2real", "compare the log of a real drive with the simulator"),
    "replay": ("replay", "replay the steps that led to a non-finite state"),
    "pretrained": ("pretrained", "copy the policies that come with the package"),
}
"""The commands by name, in the order in which a user needs them: the module, and what it does."""


def _parser() -> cli.Parser:
    pages = shipped_folder("docs") / "llms.txt"
    parser = cli.Parser(
        prog=cli.PROGRAM,
        description="Train a JetBot to drive to goals.",
        epilog=f"for coding assistants: {str(pages).replace('%', '%%')}",
        formatter_class=argparse.RawDescriptionHelpFormatter,  # the path stays in one piece
    )
    parser.add_argument("--version", action="version", version=f"jetbot_mjx {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND [--help]")
    for name, (_, text) in COMMANDS.items():
        commands.add_parser(name, help=text, add_help=False)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the given command, or print the list of commands.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0. A command that runs, or that does not exist, ends the process with its exit code.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words and words[0] in COMMANDS:
        sys.argv[1:] = words[1:]
        module = f"jetbot_mjx.{COMMANDS[words[0]][0]}"
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    if arguments is None:
        cli.run_command(lambda _: _overview(words))
    return _overview(words)


def _overview(words: Sequence[str]) -> int:
    """Print the list of commands, or refuse a command that does not exist."""
    parser = _parser()
    if words and (words[0] not in ("-h", "--help", "--version") or len(words) > 1):
        meant = cli.command_meant_by(words, COMMANDS)
        remedy = f": did you mean {meant}?" if meant else ""
        what = "no command before" if words[0].startswith("-") else "no command"
        parser.error(f"there is {what} {words[0]!r}{remedy}")
    parser.parse_args(words)
    parser.print_help()
    return 0


if __name__ == "__main__":
    sys.exit(main())
