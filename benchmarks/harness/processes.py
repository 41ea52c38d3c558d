"""Run a command of the package in a process of its own."""

import subprocess
import sys
from collections.abc import Mapping, Sequence

from jetbot_mjx.errors import UserError


def run_module(
    module: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None
) -> str:
    """Run `python -m jetbot_mjx.<module>` and return what it printed.

    Args:
      module: The module, for example `train`.
      arguments: Its command-line arguments.
      environment: The environment variables; None: those of this process.

    Raises:
      UserError: The process failed.
    """
    done = subprocess.run(
        [sys.executable, "-m", f"jetbot_mjx.{module}", *arguments],
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no error message"]
        raise UserError(f"{module} failed: {lines[-1]}")
    return done.stdout
