"""Compute the cache key of a configuration's compiled programs.

A traced program depends on the configuration, the model, the source of this package and of its
compiler and the installed libraries. With all of these in the key, a command loads its programs
without tracing them. What a task or an environment of one's own depends on is unknown: it is traced
first, and the trace is part of the key.
"""

import functools
import hashlib
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

import onekernel
from jetbot_mjx import fallbacks
from jetbot_mjx.config import CHANGEABLE_ON_RESUME, Config
from jetbot_mjx.devices import compiler_options
from jetbot_mjx.envs.versions import LIBRARIES, installed_version

if TYPE_CHECKING:
    import mujoco

    from jetbot_mjx.envs.adapted_env import AdaptedEnv
    from jetbot_mjx.envs.jetbot_env import JetBotEnv

_ROOTS = Path(__file__).parents[1], Path(str(onekernel.__file__)).parent
"""Folders of the packages whose complete source is part of the key."""

BUILT_IN_TASKS = frozenset({f"{_ROOTS[0].name}:GoalTask"})
"""Tasks whose source is part of the package, and so of the key."""

_NOT_IN_PROGRAMS = {
    # The seed is an argument of the programs. The length of the training is in them.
    *("seed", "init_from"),
    *(key for key in CHANGEABLE_ON_RESUME if "." not in key),
}
"""Settings that no program depends on: when a training ends, and what it reads and writes."""

SOURCES = {".ll", ".py", ".pyi", ".xml", ".yaml"}
"""Suffixes of the files from which programs are made; a `.pyi` says what a face exports."""


def is_built_in(task: str) -> bool:
    """Say whether a task, named as in `task.name`, is this package's own."""
    return task in BUILT_IN_TASKS


def open_program_cache(
    config: Config, *, keep: bool = True, own: "JetBotEnv | AdaptedEnv | None" = None
) -> onekernel.ProgramCache:
    """Open the cache of a configuration's programs.

    Args:
      config: the configuration of the run.
      keep: whether to keep the programs in JAX's folder of compiled programs.
      own: the environment, unwrapped, if it or its task is of one's own.

    Returns:
      The cache. It is in memory anyway if there is no such folder, for code of one's own that is
      not given or has no hash, and if several processes train together.
    """
    folder = jax.config.values["jax_compilation_cache_dir"]
    hashed = None if own is None else own_fingerprint(own)
    known = hashed is not None or is_built_in(config.code)
    kept = keep and folder and known and jax.process_count() == 1
    return onekernel.ProgramCache(
        compiler_options(config.deterministic),
        Path(folder) if kept else None,
        _key(config, hashed) if kept else "",
        fallbacks,
        _own_nodes(own) if kept else (),
    )


def _key(config: Config, own: str | None) -> str:
    """Return all that the programs of a configuration depend on, but for the compiler's options."""
    devices = jax.devices()
    settings = {
        name: repr(value)
        for name, value in jax.config.values.items()
        if not name.startswith(("jax_compilation_cache", "jax_persistent_cache", "jax_log"))
    }
    parts = [
        config.model_dump(mode="json", exclude=_NOT_IN_PROGRAMS),
        _own_source(*_ROOTS),
        _model(config) if own is None else own,
        sys.version,
        [installed_version(name) for name in LIBRARIES],
        settings,
        os.environ.get("XLA_FLAGS"),
        devices[0].client.platform_version,
        [device.device_kind for device in devices],
    ]
    return json.dumps(parts, sort_keys=True)


def _model(config: Config) -> str:
    """Return a hash of a configuration's MuJoCo model, including the options of its solver."""
    # Import MuJoCo late, so that a mistyped command reports its error at once.
    from jetbot_mjx.envs import robot_model, task

    scene = task.make_task(config.task).build_scene
    return _model_hash(
        robot_model.make_mj_model(config.robot, config.physics, build_scene=scene, visual=False)
    )


def own_fingerprint(env: "JetBotEnv | AdaptedEnv") -> str | None:
    """Return a hash of an environment, or of a robot's task, of one's own, from its trace.

    Args:
      env: the environment, unwrapped.

    Returns:
      The hash; None: the code depends on something that has none, such as a call of Python.
    """
    from jetbot_mjx.envs.adapted_env import AdaptedEnv
    from jetbot_mjx.envs.checks.probe import TaskProbe, call_methods, first_key
    from onekernel.build import fingerprint

    if isinstance(env, AdaptedEnv):
        return fingerprint(*env.traced)
    task = env.task
    methods = jax.make_jaxpr(call_methods(task))(TaskProbe(task, env.config).example)
    sample, goal = jax.make_jaxpr(task.sample, return_shape=True)(first_key())
    found = fingerprint(methods, sample)
    # Arguments and results of the programs are stored with the structure of the goal, which a trace
    # does not tell.
    structure = jax.tree.structure(goal)
    return found and f"{found} {structure} {task.layout} {_model_hash(env.physics.mj_model)}"


def _own_nodes(env: "JetBotEnv | AdaptedEnv | None") -> list[type]:
    """Return the classes that a task's goal consists of; none for an environment of one's own."""
    from jetbot_mjx.envs.adapted_env import AdaptedEnv
    from jetbot_mjx.envs.checks.probe import first_key

    if env is None or isinstance(env, AdaptedEnv):
        return []
    found = []
    trees = [jax.tree.structure(jax.eval_shape(env.task.sample, first_key()))]
    while trees:
        tree = trees.pop()
        if node := tree.node_data():
            found.append(node[0])
            trees += tree.children()
    return found


def _model_hash(model: "mujoco.MjModel") -> str:
    """Return a hash of a MuJoCo model."""
    import mujoco

    content = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()


@functools.cache
def _own_source(*roots: Path) -> str:
    """Return a hash of all source files in the folders of packages."""
    digest = hashlib.sha256()
    for root in roots:
        for path in sorted(root.rglob("*")):
            if path.suffix in SOURCES:
                digest.update(str(path.relative_to(root.parent)).encode() + path.read_bytes())
    return digest.hexdigest()
