"""Search for hyperparameters, many trials at once, with Optuna.

The study lies in the output folder. The same command goes on where a search was stopped, and
several workers may run it with one `--storage`.
"""

import time
from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.config import load_config
from jetbot_mjx.runs.run_dir import default_run_dir


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and search.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.tune", description=__doc__)
    parser.add_argument("--config", type=Path, required=True, help="YAML file, see configs/")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="SECTION.KEY=VALUE"
    )
    parser.add_argument(
        "--space", type=Path, required=True, help="YAML file with the settings to change"
    )
    parser.add_argument("--trials", type=cli.positive_int, default=64, help="default: 64")
    parser.add_argument(
        "--round", type=cli.whole_number(1, 1024), default=16, help="trials at once (default: 16)"
    )
    parser.add_argument(
        "--storage", metavar="URL", help="database of the study (default: SQLite in the output)"
    )
    parser.add_argument(
        "--confirm",
        type=cli.whole_number(0),
        default=3,
        metavar="N",
        help="how many of the best trials to train anew with five new seeds (default: 3)",
    )
    parser.add_argument("--output", type=Path, help="default: runs/tune-<config>-<date>-<time>")
    options = parser.parse_args(arguments)
    config = load_config(options.config, options.overrides)
    cli.wake_device()
    from jetbot_mjx.tuning import results, search
    from jetbot_mjx.tuning.space import read_space

    space = read_space(options.space, config)
    cli.require_device()
    use_compilation_cache()
    folder = options.output or default_run_dir(Path(f"tune-{options.config.stem}"))
    began = time.perf_counter()
    study = search.Search(config, space, folder, storage=options.storage, say=_say)
    study.run(options.trials, options.round)
    _say(f"search: {time.perf_counter() - began:.1f} s")
    entrants = study.confirm(options.confirm, seeds=5)
    path = results.write_results(folder, config, study.study, entrants)
    print(
        f"\ntrained anew with 5 new seeds, evaluated on the report's goals:\n\n"
        f"{results.entrants_table(entrants)}\n\n{time.perf_counter() - began:.1f} s in all\n"
        f"results: {folder}\nnext: python -m jetbot_mjx.train --config {path}"
    )
    return 0


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
