"""Render a policy that drives: `jetbot-mjx render RUN` writes an mp4, a gif and a plot.

By default the best checkpoint drives to the first of the report's fixed goals. `--goals 3,17`
chooses other goals. `--gallery` renders the first, the middle and the last checkpoint side by side,
driving to the same goals. `--many 1024` renders so many robots in one scene. `--strip` renders an
image of an untrained, an early and a trained policy.
"""

import argparse
from collections.abc import Sequence

from jetbot_mjx import cli, startup
from jetbot_mjx.evaluation import REPORT_GOALS


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx render", description=__doc__)
    cli.add_checkpoint_arguments(parser)
    group = parser.add_mutually_exclusive_group()
    defaults = "default: 8; 4 with --gallery; 3 in an environment"
    first = f"drive to the first N of the fixed goals ({defaults})"
    cli.add_count(group, "--episodes", first, most=REPORT_GOALS)
    group.add_argument(
        "--goals",
        type=cli.goals,
        metavar="I,J-K",
        help="drive to these of the fixed goals, such as 3,17 or 0-7",
    )
    many = "N robots in one scene, each with its own goal"
    cli.add_count(group, "--many", many, most=REPORT_GOALS)
    gallery = "the first, the middle and the last checkpoint of the run side by side"
    cli.add_flag(parser, "--gallery", gallery)
    cli.add_flag(parser, "--strip", "one image of an untrained, an early and a trained policy")
    size = "width and height of the video in pixels (default: 1280x720; 1280x480 with --gallery)"
    parser.add_argument("--size", type=cli.size, metavar="WxH", help=size)
    return parser


def _check(parser: cli.Parser, options: argparse.Namespace) -> None:
    """Refuse options that do not go together."""
    chosen = options.which != "best"
    for both, option, other in (
        (options.gallery and options.goals, "--goals", "--gallery"),
        (options.gallery and chosen, "--checkpoint", "--gallery"),
        (options.gallery and options.many, "--many", "--gallery"),
        (options.strip and chosen, "--checkpoint", "--strip"),
        (options.strip and options.gallery, "--strip", "--gallery"),
        (options.strip and options.goals, "--goals", "--strip"),
        (options.strip and options.episodes, "--episodes", "--strip"),
        (options.strip and options.size, "--size", "--strip"),
    ):
        if both:
            parser.error(f"{option}: cannot be combined with {other}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and render.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    _check(parser, options)
    run, which, size = cli.find_policy(options.run), options.which, options.size
    with startup.exit_on_interrupt():
        from jetbot_mjx.viewers import (
            GALLERY_EPISODES,
            render_gallery,
            render_many,
            render_run,
            render_training_strip,
        )
    cli.prepare_device()
    with cli.trusting(options.trust), cli.show_progress():
        if options.gallery:
            rendered = render_gallery(run, episodes=options.episodes or GALLERY_EPISODES, size=size)
        elif options.strip:
            rendered = render_training_strip(run, robots=options.many or 16)
        elif options.many:
            rendered = render_many(run, robots=options.many, which=which, size=size)
        else:
            rendered = render_run(
                run, episodes=options.episodes, goals=options.goals, which=which, size=size
            )
    cli.tell(rendered.describe())
    return 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True, writes_files=True)
