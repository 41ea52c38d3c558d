"""Check a task or an environment before it is trained: `jetbot-mjx check-env my_env.yaml`.

Every mistake is reported in one line that says how to correct it. Name a configuration, a class as
`file.py:Class` or `package.module:Class`, or a built-in task by its class alone, such as
`GoalTask`. `--config` checks a class with the settings of a run. Of an environment of your own,
sizes and costs are told, too.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from jetbot_mjx import cli, startup
from jetbot_mjx.config import YAML_ENDINGS, Config, class_name, shipped_configs
from jetbot_mjx.errors import InvalidError

BROKEN = 1
"""Exit code for a task or an environment that has an error."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and check the task or the environment.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0, or 1 if there is an error.
    """
    parser = cli.Parser(prog="jetbot-mjx check-env", description=__doc__)
    parser.add_argument(
        "what",
        nargs="?",
        metavar="CONFIG|file.py:Class",
        help="a configuration, a task or an environment (default: that of --config)",
    )
    cli.add_config_arguments(parser, positional=False)
    options = parser.parse_args(arguments)
    if not options.what and options.config is None:
        parser.error("give a configuration, or a class as file.py:Class")
    if (options.what or "").endswith(".py"):
        parser.error(f"{options.what} is a file: name its class too, as {options.what}:Class")
    with startup.exit_on_interrupt():
        from jetbot_mjx import envs
    config = _config(options)
    cli.prepare_device()
    if config.environment is None:
        about = {name: text for name, (_, text) in envs.CHECKS.items()}
        return _tell(config, about, envs.check_task(config))
    code = _tell(config, envs.ENVIRONMENT_CHECKS, envs.check_environment(config))
    if code == 0:
        for label, text in envs.describe_environment(config):
            cli.tell(f"{label:10} {text}")
    return code


def _config(options: argparse.Namespace) -> Config:
    """Return the configuration to check."""
    what = options.what
    if not what:
        return cli.config_of(options)
    if ":" in what:
        try:
            what = class_name(what)
        except ValueError as error:
            raise InvalidError(str(error)) from None
    if options.config is None and (what.endswith(YAML_ENDINGS) or what in shipped_configs()):
        options.config = Path(what)
        return cli.config_of(options)
    if _is_environment(what):
        return cli.config_of(options, f"environment={what}")
    name = what if ":" in what else f"jetbot_mjx:{what}"
    return cli.config_of(options, f"task.name={name}")


def _is_environment(name: str) -> bool:
    """Return whether a class has the methods of an environment, which those of a task are not."""
    from jetbot_mjx.envs import import_class

    return ":" in name and hasattr(import_class("environment", name), "step")


def _tell(
    config: Config, about: Mapping[str, str], checked: Iterable[tuple[str, list[str]]]
) -> int:
    """Print each result as soon as it is known, and return the exit code."""
    errors, remaining = 0, list(about)
    for name, findings in checked:
        errors += len(findings)
        remaining.remove(name)
        cli.tell(f"{'wrong' if findings else 'ok':5}  {name:9}  {about[name]}")
        for finding in findings:
            cli.tell(f"{'':7}- {finding}")
    if errors and remaining:
        cli.tell(f"not checked until that is corrected: {', '.join(remaining)}")
    total = f"{errors} error{'s' * (errors > 1)}" if errors else "no errors"
    cli.tell(f"{config.code}: {total}")
    return BROKEN if errors else 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
