"""Choose how a training shows its progress: a dashboard, or plain lines."""

import sys
from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx.runs import History
from jetbot_mjx.terminal import is_watched
from jetbot_mjx.training.console import Terminal


def open_terminal(
    run_dirs: Sequence[Path], total_steps: int, histories: Sequence[Sequence[History]]
) -> Terminal:
    """Return a dashboard if standard output is a terminal in the foreground, else plain lines.

    As rich does, `TERM=dumb` and `TTY_INTERACTIVE=0` select plain lines, `NO_COLOR` no colours.

    Args:
      run_dirs: the folder of each seed.
      total_steps: environment steps of the whole training.
      histories: the metrics that each seed has logged before.

    Returns:
      The terminal.
    """
    if not sys.stdout.isatty():
        return Terminal(total_steps)
    # Rich is needed on a terminal alone.
    from rich.console import Console

    # With its own file: `sys.stdout` is replaced while the dashboard is drawn.
    console = Console(file=sys.stdout, highlight=False)
    if not is_watched(console):
        return Terminal(total_steps)
    from jetbot_mjx.training.dashboard import Dashboard

    seeds = [folder.name.removeprefix("seed-") for folder in run_dirs]
    title = (run_dirs[0] if len(run_dirs) == 1 else run_dirs[0].parent).name
    return Dashboard(title, total_steps, seeds, histories, console)
