"""Replay the steps before a non-finite state: `jetbot-mjx replay RUN/nan_dumps/FILE`."""

from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli, startup

NOT_REPRODUCED = 1
"""Exit code if the state stays finite."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and replay.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0, or 1 if the state stayed finite this time.
    """
    parser = cli.Parser(prog="jetbot-mjx replay", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help="a file in a run's nan_dumps/")
    cli.add_trust(parser)
    options = parser.parse_args(arguments)
    with startup.exit_on_interrupt():
        from jetbot_mjx.envs import make_env
        from jetbot_mjx.runs import format_step, load_nan_dump, replay_header, replay_nan_dump
    cli.prepare_device()
    with cli.trusting(options.trust):
        stored = load_nan_dump(options.file)
    env = make_env(stored.config.for_any_device(), own_class=stored.own_class)
    cli.tell(
        f"the state became non-finite before step {stored.env_steps:,} of the training; the unroll"
        f" up to there:\n{replay_header(env)}"
    )
    nonfinite: list[str] = []
    for index, step in enumerate(replay_nan_dump(stored, env)):
        cli.tell(format_step(index, step))
        nonfinite = step.nonfinite
    if not nonfinite:
        cli.tell("the state stayed finite here: other devices and versions round differently")
        return NOT_REPRODUCED
    return 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
