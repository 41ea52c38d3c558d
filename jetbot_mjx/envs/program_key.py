"""Know what the compiled programs of a configuration depend on.

What is traced depends on the configuration, on the model, on this package's source and on what is
installed: under these a command finds its programs at once. It does so only for tasks of this
package, since nobody can say what a task of someone else's depends on.
"""

import functools
import hashlib
import importlib.metadata
import json
import os
import sys
from pathlib import Path

import jax
import numpy as np

from jetbot_mjx.compiler.program_cache import ProgramCache, processor
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.config import Config

_ROOT = Path(__file__).parents[1]
"""Of the package, all of whose source is part of the key."""

TRUSTED = frozenset({f"{_ROOT.name}:GoalTask"})
"""Tasks whose source is part of the key."""

SOURCES = {".ll", ".py", ".xml"}
"""Of what programs are made from, as files of this package end."""

_LIBRARIES = ["brax", "flax", "jax", "jaxlib", "llvmlite", "mujoco", "mujoco-mjx", "numpy", "optax"]


def open_program_cache(config: Config, *, keep: bool) -> ProgramCache:
    """Return the programs of a configuration on the devices of this process.

    Args:
      config: the run.
      keep: whether to keep them in JAX's folder of compiled programs, if there is one.

    Returns:
      They, not compiled yet.
    """
    options = compiler_options(config)
    folder = jax.config.values["jax_compilation_cache_dir"]
    own_task = config.task.name not in TRUSTED
    if not keep or folder is None or own_task or jax.process_count() > 1:
        return ProgramCache(options)
    devices = jax.devices()
    settings = {
        name: repr(value)
        for name, value in jax.config.values.items()
        if not name.startswith(("jax_compilation_cache", "jax_persistent_cache", "jax_log"))
    }
    cache_key = [
        # Seeds are arguments of programs.
        config.model_copy(update={"seed": 0}).model_dump(mode="json"),
        _own_source(),
        _model(config),
        sys.version,
        [_version(name) for name in _LIBRARIES],
        settings,
        os.environ.get("XLA_FLAGS"),
        processor(),
        devices[0].client.platform_version,
        [device.device_kind for device in devices],
    ]
    return ProgramCache(options, Path(folder), json.dumps(cache_key, sort_keys=True))


def _version(library: str) -> str | None:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None


def _model(config: Config) -> str:
    """Return a name for the model of a configuration, with all options of its solver."""
    # A mistyped command says so before MuJoCo is loaded.
    import mujoco

    from jetbot_mjx.envs import robot_model, task

    scene = task.make_task(config.task).build_scene
    robot = robot_model.ROBOTS[config.robot.preset]
    made = robot_model.make_mj_model(robot, config.physics, build_scene=scene, visual=False)
    content = np.zeros(mujoco.mj_sizeModel(made), np.uint8)
    mujoco.mj_saveModel(made, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()


@functools.cache
def _own_source() -> str:
    """Return a name for all that this package consists of."""
    digest = hashlib.sha256()
    for path in sorted(_ROOT.rglob("*")):
        if path.suffix in SOURCES:
            digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.hexdigest()
