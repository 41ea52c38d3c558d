"""List the runs in a folder, the latest first, and the names by which commands find them.

`--open latest` opens the report of a run in the browser, `--compare A B` shows what two runs differ
in, and `--delete NAME` removes one after a question. The success rate is that of the best
evaluation during the training; `jetbot-mjx evaluate` measures it with more goals.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli, errors, startup

_SORTS = ("age", "name", "steps", "success")


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx runs", description=__doc__)
    folder = "folder of the runs (default: runs)"
    parser.add_argument("folder", type=Path, nargs="?", metavar="DIR", help=folder)
    text = "list only runs whose name or task contains this text"
    parser.add_argument("--filter", metavar="TEXT", default="", help=text)
    cli.add_choice(parser, "--sort", _SORTS, "order of the list")
    parser.set_defaults(sort=None)  # to tell whether it was given
    cli.add_flag(parser, "--json", "print the list as JSON")
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--open", metavar="RUN", help="open the newest report of a run")
    two = "show the settings and results in which two runs differ"
    action.add_argument("--compare", nargs=2, metavar="RUN", help=two)
    action.add_argument("--delete", metavar="RUN", help="delete a run, after a question")
    cli.add_flag(parser, "--yes", "delete without a question")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and list, open, compare or delete runs.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.yes and not options.delete:
        parser.error("--yes: it belongs to --delete")
    _refuse_both(parser, options)
    if options.folder and not options.folder.is_dir():
        parser.error(f"{options.folder} is not a folder")
    with startup.exit_on_interrupt():
        from jetbot_mjx.runs import changes_table, compare_two, list_runs, newest_report

    if options.open:
        report = newest_report(cli.find_policy(options.open, "run"))
        cli.tell(f"report: {report}")
        cli.open_page(report)
    elif options.compare:
        before, after = (cli.find_policy(name, "run") for name in options.compare)
        if before.resolve() == after.resolve():
            parser.error(f"--compare {' '.join(options.compare)}: both are the same run, {before}")
        cli.tell(changes_table(compare_two(before, after)))
    elif options.delete:
        _delete(options.delete, asks=not options.yes)
    else:
        how = {"text": options.filter, "sort": options.sort or _SORTS[0], "as_json": options.json}
        cli.tell(list_runs(options.folder, **how))
    return 0


def _refuse_both(parser: cli.Parser, options: argparse.Namespace) -> None:
    """Refuse what narrows or shapes the list where a run is named: another one might be meant."""
    action = next((one for one in ("open", "compare", "delete") if getattr(options, one)), None)
    for name in ("filter", "sort", "json", "folder"):
        if action and (given := getattr(options, name)):
            what = given if name == "folder" else f"--{name}"
            parser.error(f"{what}: it is for the list, and --{action} takes a run itself")


def _delete(name: str, *, asks: bool) -> None:
    """Delete a run, after a question.

    Raises:
      UserError: it is not a run of the user, a training writes it, or nobody can be asked.
    """
    from jetbot_mjx.runs import delete_run, find_deletable

    run = find_deletable(cli.find_policy(name, "run"))
    if asks:
        if not sys.stdin.isatty():
            raise errors.UserError(f"--delete {name}: nobody can be asked here: add --yes")
        answer = input(f"delete {run.path}, {run.env_steps:,} steps of {run.task}? [y/N] ")
        if answer.strip().lower() not in ("y", "yes"):
            cli.tell("nothing was deleted")
            return
    delete_run(run)
    cli.tell(f"deleted: {run.path}")


if __name__ == "__main__":
    cli.run_command(main)
