"""Predict the memory that a training needs: `jetbot-mjx plan gpu`.

The table shows the memory of each device for more and for fewer environments. It is computed from
shapes alone: nothing is compiled and nothing is trained.
"""

from collections.abc import Sequence

from jetbot_mjx import cli, startup

TOO_LARGE = 1
"""Exit code if the configuration does not fit."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and predict the memory.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0, or 1 if the configuration does not fit as it is.
    """
    parser = cli.Parser(prog="jetbot-mjx plan", description=__doc__)
    cli.add_config_arguments(parser)
    parser.add_argument(
        "--memory",
        type=cli.number(float, 0.001),
        metavar="GIB",
        help="memory of each device (default: that of this machine's devices)",
    )
    options = parser.parse_args(arguments)
    cli.require_config(parser, options)
    config = cli.config_of(options)
    with startup.exit_on_interrupt():
        from jetbot_mjx.training import memory_table, plan_memory
    startup.divide_cpu(config.cpu_devices)
    cli.prepare_device()
    plan = plan_memory(config, options.memory)
    cli.tell(memory_table(plan))
    return 0 if plan.fits else TOO_LARGE


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
