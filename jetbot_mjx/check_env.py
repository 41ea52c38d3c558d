"""Checks a task before it is trained: `python -m jetbot_mjx.check_env my_task:MyTask`.

Every fault in one line, with the remedy. A built-in task goes by its class alone, such as
`GoalTask`; one with settings is checked as a run would have it, `--config my_task.yaml`.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.envs.checks.runner import CHECKS, MEANINGS, Finding, check_task

BROKEN = 1
"""Exit code for a task that has an error."""

_BUILT_IN = "jetbot_mjx"


def run(config: Config) -> Iterator[tuple[str, list[Finding]]]:
    """Check the task of a configuration.

    Args:
      config: the configuration of the run.

    Returns:
      An iterator over each check's name and findings, as the checks finish.

    Raises:
      UserError: there is no such task, or it rejects the configuration.
    """
    return check_task(config)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and check the task.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0, or 1 if the task has an error.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.check_env", description=__doc__)
    parser.add_argument(
        "task", nargs="?", metavar="package.module:Class", help="default: that of --config"
    )
    parser.add_argument("--config", type=Path, help="YAML file with the task's settings")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override one setting; may be given again",
    )
    options = parser.parse_args(arguments)
    if not options.task and options.config is None:
        parser.error("name a task as package.module:Class, or a --config that does")
    overrides = list(options.overrides)
    if options.task:
        name = options.task if ":" in options.task else f"{_BUILT_IN}:{options.task}"
        overrides.append(f"task.name={name}")
    config = load_config(options.config, overrides)
    cli.require_device()
    use_compilation_cache()
    wrong, left = 0, list(CHECKS)
    for name, findings in run(config):
        wrong += len(findings)
        left.remove(name)
        print(f"{'wrong' if findings else 'ok':5}  {name:8}  {MEANINGS[name]}", flush=True)
        for finding in findings:
            print(f"{'':7}- {finding.message}", flush=True)
    if wrong and left:
        print(f"not checked until that is mended: {', '.join(left)}")
    print(
        f"{config.task.name}: "
        + (f"{wrong} fault{'s' * (wrong > 1)}" if wrong else "nothing wrong")
    )
    return BROKEN if wrong else 0


if __name__ == "__main__":
    cli.run_command(main)
