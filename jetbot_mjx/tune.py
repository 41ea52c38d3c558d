"""Search for hyperparameters, many trials at once, with Optuna.

The study is stored in the output folder. The same command with the same `--output` continues a
search that was stopped, and several workers may share one study through `--storage`.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli, startup


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx tune", description=__doc__)
    cli.add_config_arguments(parser)
    what = "YAML file with the settings to search, or `ppo` or `time`, which come with the package"
    parser.add_argument("--space", type=Path, required=True, metavar="SPACE", help=what)
    parser.add_argument(
        "--objective",
        choices=("learning", "time"),
        default="learning",
        help="what to improve: the mean success while learning, or the time to the goals of"
        " policies that reach 99.9 %% of them (default: learning)",
    )
    cli.add_count(parser, "--trials", "how many trials the study shall have", default=64)
    cli.add_count(parser, "--round", "how many trials to train at once", most=1024, default=16)
    parser.add_argument(
        "--storage", metavar="URL", help="database of the study (default: SQLite in --output)"
    )
    given = "beside the configuration as given; 0: none"
    text = f"how many of the best trials to retrain with new seeds, {given}"
    cli.add_count(parser, "--confirm", text, least=0, default=3)
    cli.add_output(parser, "default: runs/tune-<config>-<date>-<time>")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and search.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    options = (parser := _parser()).parse_args(arguments)
    cli.require_config(parser, options)
    startup.wake_driver()
    config = cli.config_of(options)
    startup.wake_device()
    with startup.exit_on_interrupt():
        from jetbot_mjx.runs import claim_run_dir
        from jetbot_mjx.terminal import process_seconds
        from jetbot_mjx.tuning import CONFIRM_SEEDS, entrants_table, read_space, run_search
    space = read_space(options.space, config)
    cli.prepare_device()
    name = Path(f"tune-{options.config.stem}")
    with cli.show_progress(), claim_run_dir(options.output, name) as folder:
        found = run_search(
            config,
            space,
            folder,
            trials=options.trials,
            round_size=options.round,
            confirm=options.confirm,
            objective=options.objective,
            storage=options.storage,
            say=cli.tell,
        )
    if found.entrants:
        cli.tell(
            f"\nretrained with {CONFIRM_SEEDS} new seeds, evaluated on the report's goals:\n\n"
            f"{entrants_table(found.entrants)}\n"
        )
    cli.tell(
        f"total {process_seconds():.1f} s\nresults: {folder}\n"
        f"next: jetbot-mjx train {shlex.quote(str(found.config_file))}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True, writes_files=True)
