"""Check a task before it is trained: `jetbot-mjx check-env my_task:MyTask`.

Every mistake is reported in one line that says how to correct it. A built-in task is named by its
class alone, such as `GoalTask`. `--config my_task.yaml` checks a task with the settings of a run.
"""

from collections.abc import Sequence

from jetbot_mjx import cli, startup

BROKEN = 1
"""Exit code for a task that has an error."""

_BUILT_IN = "jetbot_mjx"


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and check the task.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0, or 1 if the task has an error.
    """
    # Parse.
    parser = cli.Parser(prog="jetbot-mjx check-env", description=__doc__)
    parser.add_argument(
        "task",
        nargs="?",
        metavar="package.module:Class",
        help="the task (default: the task of --config)",
    )
    cli.add_config_arguments(parser, positional=False)
    options = parser.parse_args(arguments)
    if not options.task and options.config is None:
        parser.error("give a task as package.module:Class, or a --config that names one")
    if (options.task or "").endswith((".yaml", ".yml")):
        parser.error(f"{options.task} is a YAML file: did you mean --config {options.task}?")
    if (options.task or "").endswith(".py"):
        module = options.task.removesuffix(".py").replace("/", ".")
        parser.error(f"{options.task} is a file: name its class too, as {module}:Class")
    name = options.task if ":" in (options.task or "") else f"{_BUILT_IN}:{options.task}"
    config = cli.config_of(options, *([f"task.name={name}"] if options.task else []))
    with startup.exit_on_interrupt():
        from jetbot_mjx.envs import CHECKS, check_task
    cli.prepare_device()
    # Check, and print each result as soon as it is known.
    errors, remaining = 0, list(CHECKS)
    for name, findings in check_task(config):
        errors += len(findings)
        remaining.remove(name)
        cli.tell(f"{'wrong' if findings else 'ok':5}  {name:8}  {CHECKS[name][1]}")
        for finding in findings:
            cli.tell(f"{'':7}- {finding}")
    # Summarise.
    if errors and remaining:
        cli.tell(f"not checked until that is corrected: {', '.join(remaining)}")
    total = f"{errors} error{'s' * (errors > 1)}" if errors else "no errors"
    cli.tell(f"{config.task.name}: {total}")
    return BROKEN if errors else 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
