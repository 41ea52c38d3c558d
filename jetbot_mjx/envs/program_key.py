"""Compute the cache key of a configuration's compiled programs.

A traced program depends on the configuration, the model, this package's source and the installed
libraries. With all of these in the key, a command loads its programs without tracing them. This
holds only for the tasks of this package, because the dependencies of any other task are unknown.
"""

import functools
import hashlib
import json
import os
import sys
from pathlib import Path

import jax
import numpy as np

from jetbot_mjx.compiler.program_cache import ProgramCache, processor
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.config import Config
from jetbot_mjx.imports import LIBRARIES, installed_version

_ROOT = Path(__file__).parents[1]
"""Folder of the package, whose complete source is part of the key."""

TRUSTED = frozenset({f"{_ROOT.name}:GoalTask"})
"""Tasks whose source is part of the package, and so of the key."""

_NOT_IN_PROGRAMS = {
    # The seed is an argument of the programs.
    "seed",
    "init_from",
    "stop_at_success",
    "checkpoint_interval",
    "checkpoints_to_keep",
    "preemption_notice",
    "tensorboard",
    "wandb",
}
"""Settings that no program depends on: when a training ends, and what it reads and writes."""

SOURCES = {".ll", ".py", ".xml"}
"""Suffixes of the files from which programs are made."""


def open_program_cache(config: Config) -> ProgramCache:
    """Open the cache of a configuration's programs in JAX's folder of compiled programs.

    Args:
      config: the configuration of the run.

    Returns:
      The cache. It is in memory only if there is no such folder, for other tasks than this
      package's, and if several processes train together.
    """
    options = compiler_options(config)
    folder = jax.config.values["jax_compilation_cache_dir"]
    if folder is None or config.task.name not in TRUSTED or jax.process_count() > 1:
        return ProgramCache(options)
    devices = jax.devices()
    settings = {
        name: repr(value)
        for name, value in jax.config.values.items()
        if not name.startswith(("jax_compilation_cache", "jax_persistent_cache", "jax_log"))
    }
    cache_key = [
        config.model_dump(mode="json", exclude=_NOT_IN_PROGRAMS),
        _own_source(),
        _model(config),
        sys.version,
        [installed_version(name) for name in LIBRARIES],
        settings,
        os.environ.get("XLA_FLAGS"),
        processor(),
        devices[0].client.platform_version,
        [device.device_kind for device in devices],
    ]
    return ProgramCache(options, Path(folder), json.dumps(cache_key, sort_keys=True))


def _model(config: Config) -> str:
    """Return a hash of a configuration's MuJoCo model, including the options of its solver."""
    # Import MuJoCo late, so that a mistyped command reports its error at once.
    import mujoco

    from jetbot_mjx.envs import robot_model, task

    scene = task.make_task(config.task).build_scene
    robot = robot_model.ROBOTS[config.robot.preset]
    model = robot_model.make_mj_model(robot, config.physics, build_scene=scene, visual=False)
    content = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()


@functools.cache
def _own_source() -> str:
    """Return a hash of all source files of this package."""
    digest = hashlib.sha256()
    for path in sorted(_ROOT.rglob("*")):
        if path.suffix in SOURCES:
            digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.hexdigest()
