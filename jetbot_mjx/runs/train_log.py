"""Keep the messages of a training in its run folder, for when nobody reads its terminal."""

import contextlib
import time
from pathlib import Path

from jetbot_mjx.runs.run_dir import open_at_once

TRAIN_LOG = "train.log"
"""Name of the file of messages in a run folder."""


def log_message(run_dir: Path, text: str) -> None:
    """Append a message with the time to the log of a run.

    What a terminal shows is no reason to end a training, so a log that cannot be written is left as
    it is. The metrics and checkpoints report a full disk.

    Args:
      run_dir: the run folder, which must exist.
      text: the message, of one line or more.
    """
    now = time.strftime("%Y-%m-%d %H:%M:%S")
    lines = "".join(f"{now}  {line}\n" for line in text.splitlines())
    # A pipe in its place, which nobody reads, must not hold the training up.
    with (
        contextlib.suppress(OSError),
        open(run_dir / TRAIN_LOG, "a", encoding="utf-8", opener=open_at_once) as file,
    ):
        file.write(lines)
