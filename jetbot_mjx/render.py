"""Render a policy that drives: `python -m jetbot_mjx.render RUN` writes an mp4, a gif and a plot.

By default the best checkpoint drives to the first of the report's fixed goals. `--goals 3,17`
chooses other goals. `--gallery` renders the first, the middle and the last checkpoint side by side,
driving to the same goals.
"""

import argparse
from collections.abc import Callable, Sequence

from jetbot_mjx import cli
from jetbot_mjx.errors import UserError
from jetbot_mjx.interrupts import exit_on_interrupt


def _parser(most: int, parse_goals: Callable[[str], list[int]]) -> cli.Parser:
    def goals(text: str) -> list[int]:
        try:
            return parse_goals(text)
        except UserError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    parser = cli.Parser(prog="jetbot-mjx render", description=__doc__)
    cli.add_checkpoint_arguments(parser)
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--episodes",
        type=cli.whole_number(1, most),
        metavar="N",
        help="the first N of the fixed goals (default: 20, of a gallery 4)",
    )
    group.add_argument(
        "--goals", type=goals, metavar="I,J-K", help="these of the fixed goals, as in 3,17 or 0-7"
    )
    parser.add_argument(
        "--gallery",
        action="store_true",
        help="the first, the middle and the last checkpoint of the run side by side",
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and render.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    with exit_on_interrupt():
        from jetbot_mjx.evaluation.evaluator import REPORT_GOALS
        from jetbot_mjx.viewers.gallery import parse_goals, render_gallery, render_run
    # Parse.
    parser = _parser(REPORT_GOALS, parse_goals)
    options = parser.parse_args(arguments)
    if options.gallery and options.goals:
        parser.error("--goals: a gallery shows the first goals, chosen before anyone saw them")
    if options.gallery and options.checkpoint != "best":
        parser.error("--checkpoint: a gallery shows the first, the middle and the last")
    cli.prepare_device()
    # Render several checkpoints, or one.
    if options.gallery:
        gallery = render_gallery(options.run, episodes=options.episodes or 4)
        for step, successes in gallery.successes.items():
            print(f"{step:>12,} steps  {successes} of {gallery.episodes} goals reached")
        print(f"video: {gallery.mp4}\ngif:   {gallery.gif}\nplots: {gallery.plots}")
        return 0
    rendered = render_run(
        options.run, episodes=options.episodes or 20, goals=options.goals, which=options.checkpoint
    )
    print(
        f"{rendered.successes} of {rendered.episodes} goals reached\n"
        f"video: {rendered.mp4}\ngif:   {rendered.gif}\nplot:  {rendered.trajectories}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
