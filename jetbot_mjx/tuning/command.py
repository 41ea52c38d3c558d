"""Search for hyperparameters, many trials at once, with Optuna.

The study lies in the output folder. The same command with the same `--output` continues a search
that was stopped, and several workers may share one study through `--storage`.
"""

from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli
from jetbot_mjx.interrupts import exit_on_interrupt

CONFIRM_SEEDS = 5
"""How many new seeds the best trials are trained with."""


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx tune", description=__doc__)
    cli.add_config_arguments(parser, required=True)
    parser.add_argument(
        "--space", type=Path, required=True, metavar="FILE", help="YAML file: what to search"
    )
    parser.add_argument(
        "--trials", type=cli.positive_int, default=64, metavar="N", help="default: 64"
    )
    parser.add_argument(
        "--round",
        type=cli.whole_number(1, 1024),
        default=16,
        metavar="N",
        help="how many trials to train at once (default: 16)",
    )
    parser.add_argument(
        "--storage", metavar="URL", help="database of the study (default: SQLite in the output)"
    )
    parser.add_argument(
        "--confirm",
        type=cli.whole_number(0),
        default=3,
        metavar="N",
        help=f"how many of the best trials to train anew with {CONFIRM_SEEDS} new seeds"
        " (default: 3)",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="default: runs/tune-<config>-<date>-<time>"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and search.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    options = _parser().parse_args(arguments)
    cli.wake_driver()
    config = cli.config_of(options)
    cli.divide_cpu(config.cpu_devices)
    cli.wake_device()
    with exit_on_interrupt():
        from jetbot_mjx.runs.metrics import process_seconds
        from jetbot_mjx.runs.run_dir import default_run_dir
        from jetbot_mjx.tuning import results, search
        from jetbot_mjx.tuning.space import read_space
    space = read_space(options.space, config)
    cli.prepare_device()
    folder = options.output or default_run_dir(Path(f"tune-{options.config.stem}"))
    # Search.
    with cli.show_progress():
        study = search.Search(config, space, folder, storage=options.storage, say=_say)
        study.run(options.trials, options.round)
        _say(f"search done {process_seconds():.1f} s after the start")
        # Train the best anew, and write the results.
        entrants = study.confirm(options.confirm, CONFIRM_SEEDS)
    path = results.write_results(folder, config, study.study, entrants)
    _say(
        f"\ntrained anew with {CONFIRM_SEEDS} new seeds, evaluated on the report's goals:\n\n"
        f"{results.entrants_table(entrants)}\n\n{process_seconds():.1f} s in all\n"
        f"results: {folder}\nnext: jetbot-mjx train {path}"
    )
    return 0


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
