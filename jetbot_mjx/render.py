"""Render a policy that drives: `python -m jetbot_mjx.render RUN` writes an mp4, a gif and a plot.

By default the best checkpoint drives to the first of the report's fixed goals. `--goals 3,17`
chooses other goals. `--gallery` renders the first, the middle and the last checkpoint side by side,
driving to the same goals. `--many 1024` renders so many robots in one scene. `--strip` renders an
image of an untrained, an early and a trained policy.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence

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
    group.add_argument(
        "--many",
        type=cli.whole_number(1, most),
        metavar="N",
        help="N robots in one scene, each of which drives to its own goal",
    )
    parser.add_argument(
        "--gallery",
        action="store_true",
        help="the first, the middle and the last checkpoint of the run side by side",
    )
    parser.add_argument(
        "--strip", action="store_true", help="an image: an untrained, an early, a trained policy"
    )
    return parser


def _print_successes(successes: Mapping[int, int], episodes: int) -> None:
    for step, count in successes.items():
        print(f"{step:>12,} steps  {count} of {episodes} goals reached")


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
        from jetbot_mjx.viewers.many import render_many, render_training_strip
    # Parse.
    parser = _parser(REPORT_GOALS, parse_goals)
    options = parser.parse_args(arguments)
    if options.gallery and options.goals:
        parser.error("--goals: a gallery shows the first goals, chosen before anyone saw them")
    if options.gallery and options.checkpoint != "best":
        parser.error("--checkpoint: a gallery shows the first, the middle and the last")
    if options.gallery and options.many:
        parser.error("--many: a gallery shows one robot at a time")
    if options.strip and (options.goals or options.episodes or options.gallery):
        parser.error("--strip: only --many goes with it")
    if options.strip and options.checkpoint != "best":
        parser.error("--checkpoint: a strip shows an untrained, an early and a trained policy")
    cli.prepare_device()
    # Render several checkpoints, or one.
    if options.gallery:
        gallery = render_gallery(options.run, episodes=options.episodes or 4)
        _print_successes(gallery.successes, gallery.episodes)
        print(f"video: {gallery.mp4}\ngif:   {gallery.gif}\nplots: {gallery.plots}")
        return 0
    if options.strip:
        strip = render_training_strip(options.run, robots=options.many or 16)
        _print_successes(strip.successes, strip.robots)
        print(f"image: {strip.png}")
        return 0
    if options.many:
        many = render_many(options.run, robots=options.many, which=options.checkpoint)
        print(f"{many.successes:,} of {many.robots:,} goals reached")
        print(f"video: {many.mp4}\ngif:   {many.gif}")
        return 0
    rendered = render_run(
        options.run,
        episodes=options.episodes or 20,
        goals=options.goals,
        which=options.checkpoint,
    )
    print(
        f"{rendered.successes} of {rendered.episodes} goals reached\n"
        f"video: {rendered.mp4}\ngif:   {rendered.gif}\nplot:  {rendered.trajectories}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
