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
        from jetbot_mjx.terminal import text_table

    rows = [("configuration", "robot or environment", "observation", "steps", "environments")]
    for name, path in shipped_configs().items():
        config = load_config(path)
        drawn = " (randomized)" if config.randomization.drawn else ""
        robot, seen = f"{config.robot.label}{drawn}", config.task.observation
        if config.environment is not None:
            robot, seen = config.environment, ""
        rows.append(
            (name, robot, seen, f"{config.ppo.num_timesteps:,}", f"{config.ppo.num_envs:,}")
        )
    print(text_table(rows, left=3))
    return 0


if __name__ == "__main__":
    cli.run_command(main)
