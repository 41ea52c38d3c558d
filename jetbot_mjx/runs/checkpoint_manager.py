"""Write checkpoints with Orbax, which takes a third of a second to import."""

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers
from orbax.checkpoint.path import atomicity

from jetbot_mjx.runs.durable import sync, sync_tree
from jetbot_mjx.runs.run_dir import JsonObject


def open_manager(
    folder: Path, keep: int, success: Mapping[int, float], step_digits: int, deleted: str
) -> ocp.CheckpointManager:
    """Open a folder of checkpoints and remove unfinished files of an earlier process.

    Args:
      folder: the folder, which must exist.
      keep: the number of latest checkpoints to keep, besides the first and the best.
      success: the success rate at each checkpoint, which the caller may add to.
      step_digits: the number of digits in the name of a checkpoint.
      deleted: the name of the folder to which a checkpoint is moved before it is deleted.

    Returns:
      Orbax's manager.
    """
    me = jax.process_index()
    # Orbax is not to wait for other processes, which do not write.
    alone = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process-{me}"
    )
    options = ocp.CheckpointManagerOptions(
        create=False,
        multiprocessing_options=alone,
        step_name_format=ocp.path.step.standard_name_format(step_format_fixed_length=step_digits),
        preservation_policy=_PreserveBestAndLatest(keep, success),
        cleanup_tmp_directories=True,
        temporary_path_class=_SyncedTemporaryPath,
        todelete_subdir=deleted,
    )
    return ocp.CheckpointManager(folder, options=options)


def start_save(
    manager: ocp.CheckpointManager,
    env_steps: int,
    trees: Mapping[str, Mapping[str, np.ndarray]],
    objects: Mapping[str, JsonObject],
) -> bool:
    """Start to write a checkpoint in the background.

    Args:
      manager: the manager from `open_manager`.
      env_steps: the number of environment steps.
      trees: the arrays by name, by the name of their tree.
      objects: JSON values by name.

    Returns:
      Whether Orbax writes it: not if there is one after as many steps or more.
    """
    arrays = {name: ocp.args.StandardSave(tree) for name, tree in trees.items()}
    values = {name: ocp.args.JsonSave(value) for name, value in objects.items()}
    return manager.save(env_steps, args=ocp.args.Composite(**arrays, **values))


class _SyncedTemporaryPath(atomicity.AtomicRenameTemporaryPath):
    """A temporary path of Orbax that gets its final name after the disk holds its content."""

    async def finalize(self) -> None:
        """Sync the content, rename, and sync the name.

        Orbax also writes two small files here, which no reader of this project reads.
        """
        await asyncio.to_thread(sync_tree, Path(self.get()))
        await super().finalize()
        await asyncio.to_thread(sync, Path(self.get_final().parent))


class _PreserveBestAndLatest(checkpoint_managers.PreservationPolicy):
    """A preservation policy of Orbax that keeps the latest, the first and the best checkpoints.

    Of equally good checkpoints the later one counts as the best.
    """

    def __init__(self, latest: int, success: Mapping[int, float]) -> None:
        self._latest = latest
        self._success = success

    def should_preserve(
        self,
        checkpoints: Sequence[checkpoint_managers.PolicyCheckpointInfo],
        *,
        context: checkpoint_managers.PreservationContext,
    ) -> Sequence[bool]:
        success = [self._success.get(one.step, -1.0) for one in checkpoints]
        best = max(range(len(success)), key=lambda index: (success[index], index), default=0)
        first_of_latest = len(checkpoints) - self._latest
        return [index in (0, best) or index >= first_of_latest for index in range(len(checkpoints))]
