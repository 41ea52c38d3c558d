"""Evaluate policies on fixed goals: `jetbot-mjx evaluate RUN [RUN ...]`.

One policy gets a report. Several seeds, or several runs, are compared as well.
"""

from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli, startup
from jetbot_mjx.evaluation import MOST_GOALS, REPORT_GOALS

BELOW_TARGET = 1
"""Exit code if a success rate is below `--min-success`."""


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx evaluate", description=__doc__)
    cli.add_checkpoint_arguments(parser, several=True)
    first = "drive to the first N of the fixed goals"
    cli.add_count(parser, "--episodes", first, most=MOST_GOALS, default=REPORT_GOALS)
    cli.add_output(parser, "folder for the report, or for the comparison of several runs or seeds")
    others = "robots that differ from the preset in friction, mass, motors and delay"
    cli.add_flag(parser, "--robustness", f"evaluate also on {others}, and in C MuJoCo")
    parser.add_argument(
        "--simulator",
        choices=("mujoco",),
        help="evaluate in another simulator too: mujoco is C MuJoCo, with other numerics than in"
        " training",
    )
    parser.add_argument(
        "--ranges",
        type=Path,
        metavar="FILE",
        help="configuration with ranges below randomization: evaluate also on one robot sampled"
        " from them for each goal (default: the ranges of the run, if any)",
    )
    parser.add_argument(
        "--min-success",
        type=cli.fraction,
        default=0.0,
        help="exit with code 1 if the success rate is below this, 0 to 1",
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and evaluate.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0, or 1 if a success rate is below `--min-success`.
    """
    # The other options are named as the arguments of the functions that evaluate.
    options = vars(_parser().parse_args(arguments))
    runs = [cli.find_policy(name) for name in options.pop("run")]
    target, trust = options.pop("min_success"), options.pop("trust")
    with startup.exit_on_interrupt():
        from jetbot_mjx.evaluation import (
            below_target,
            compare_runs,
            evaluate_run,
            summarize_comparison,
            summarize_report,
        )
        from jetbot_mjx.runs import seed_folders
        from jetbot_mjx.viewers import make_clips
    cli.prepare_device()
    with cli.trusting(trust), cli.show_progress():
        if len(runs) > 1 or seed_folders(runs[0]):
            result = compare_runs(runs, **options)
            text = summarize_comparison(result)
        else:
            result = evaluate_run(runs[0], clips=make_clips, **options)
            text = summarize_report(result)
    cli.tell(text)
    below = below_target(result, target)
    if below:
        cli.tell("\n".join(below))
    return BELOW_TARGET if below else 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True, writes_files=True)
