"""List the configurations that come with the package, which every command finds by name."""

from collections.abc import Sequence

from jetbot_mjx import cli, startup


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and list the configurations.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="jetbot-mjx configs", description=__doc__)
    parser.parse_args(arguments)
    with startup.exit_on_interrupt():
        from jetbot_mjx.config import load_config, shipped_configs

    for name, path in shipped_configs().items():
        config = load_config(path)
        print(
            f"{name:18} {config.robot.label:9} {config.task.observation:11}"
            f" {config.ppo.num_timesteps:>13,} steps in {config.ppo.num_envs:>6,} environments"
            f"{', randomized' if config.randomization.drawn else ''}"
        )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
