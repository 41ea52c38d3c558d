"""List the runs in a folder, the latest first, and the names by which commands find them.

`--open latest` opens the report of a run in the browser, `--compare A B` shows what two runs differ
in, and `--delete NAME` removes one after a question.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jetbot_mjx import cli, errors, startup

if TYPE_CHECKING:
    from jetbot_mjx.runs import DamagedRunError, RunInfo

_SORTS = ("age", "name", "steps", "success")


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx runs", description=__doc__)
    parser.add_argument(
        "folder", type=Path, nargs="?", metavar="DIR", help="folder of the runs (default: runs)"
    )
    parser.add_argument(
        "--filter", metavar="TEXT", help="list only runs whose name or task contains this text"
    )
    cli.add_choice(parser, "--sort", _SORTS, "order of the list")
    cli.add_flag(parser, "--json", "print the list as JSON")
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--open", metavar="RUN", help="open the newest report of a run")
    action.add_argument(
        "--compare", nargs=2, metavar="RUN", help="show what two runs differ in: settings, results"
    )
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
    with startup.exit_on_interrupt():
        from jetbot_mjx.runs import compare_two

    if options.folder and not options.folder.is_dir():
        parser.error(f"{options.folder} is not a folder")
    if options.open:
        _open_report(cli.find_policy(options.open))
    elif options.compare:
        cli.tell(compare_two(*map(cli.find_policy, options.compare)))
    elif options.delete:
        _delete(options.delete, asks=not options.yes)
    else:
        _list(options)
    return 0


def _list(options: argparse.Namespace) -> None:
    """Print the runs of a folder, and without one those that come with the package."""
    from jetbot_mjx.runs import PRETRAINED, ROOT, runs_table, scan_runs

    def chosen(folder: Path) -> "tuple[list[RunInfo], list[DamagedRunError]]":
        found, damaged = scan_runs(folder)
        wanted = (options.filter or "").lower()
        found = [run for run in found if wanted in f"{run.name} {run.task}".lower()]
        if options.sort != "age":
            found.sort(key=_order(options.sort))
        return found, [] if wanted else damaged

    found, damaged = chosen(options.folder or ROOT)
    if options.json:
        cli.tell(json.dumps([run.to_json() for run in found], indent=2))
        return
    cli.tell(runs_table(found, damaged))
    if not options.folder:
        cli.tell(
            "\nwith the package, for every command that takes a run:\n"
            f"{runs_table(*chosen(PRETRAINED))}"
        )


def _order(sort: str) -> "Callable[[RunInfo], str | float]":
    """Return the key of an order, in which the best or longest run is the first."""
    orders: dict[str, Callable[[RunInfo], str | float]] = {
        "name": lambda run: run.name,
        "steps": lambda run: -run.env_steps,
        "success": lambda run: -(run.success_rate or 0.0),
    }
    return orders[sort]


def _open_report(run: Path) -> None:
    """Open the newest report of a run in the browser.

    Raises:
      UserError: there is none.
    """
    import webbrowser

    pages = sorted(run.glob("evaluations/*/report.html"), key=lambda page: page.stat().st_mtime)
    if not pages:
        raise errors.NotFoundError(
            f"{run} has no report: write one with `{cli.PROGRAM} evaluate {run}`"
        )
    cli.tell(f"report: {pages[-1]}")
    if not webbrowser.open(pages[-1].resolve().as_uri()):
        cli.tell("no browser was found: open this file in one")


def _delete(name: str, *, asks: bool) -> None:
    """Delete a run, after a question.

    Raises:
      UserError: it is not a run of the user, a training writes it, or nobody can be asked.
    """
    from jetbot_mjx.runs import CONFIG, PRETRAINED, delete_run, read_info

    path = cli.find_policy(name)
    if path.resolve().parent == PRETRAINED.resolve():
        raise errors.UserError(f"--delete {name}: it comes with the package and stays")
    if not (path / CONFIG).is_file():
        raise errors.NotFoundError(f"--delete {name}: there is no run in {path}")
    run = read_info(path)
    if asks:
        if not sys.stdin.isatty():
            raise errors.UserError(f"--delete {name}: nobody can be asked here: add --yes")
        answer = input(f"delete {path}, {run.env_steps:,} steps of {run.task}? [y/N] ")
        if answer.strip().lower() not in ("y", "yes"):
            cli.tell("nothing was deleted")
            return
    delete_run(run)
    cli.tell(f"deleted: {path}")


if __name__ == "__main__":
    cli.run_command(main)
