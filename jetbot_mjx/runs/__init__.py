"""Read and write what a run folder holds: configuration, metrics, checkpoints, NaN dumps."""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.runs.checkpoint import PRETRAINED as PRETRAINED
    from jetbot_mjx.runs.checkpoint import load_checkpoint as load_checkpoint
    from jetbot_mjx.runs.checkpoint import load_policy as load_policy
    from jetbot_mjx.runs.find_run import copy_pretrained as copy_pretrained
    from jetbot_mjx.runs.nan_dump import replay_nan_dump as replay_nan_dump

__getattr__, __dir__ = load_lazily(__name__)
