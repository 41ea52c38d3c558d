"""Save non-finite states of a training to files, load them again, and replay what led to them."""

import io
import json
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jetbot_mjx import envs
from jetbot_mjx.agents import NanDump
from jetbot_mjx.config import Config, ConfigError
from jetbot_mjx.envs import AdaptedEnv, JetBotEnv, PhysicsState, State
from jetbot_mjx.errors import InvalidError, NotFoundError, UserError, shown
from jetbot_mjx.runs.checkpoint_store import flatten
from jetbot_mjx.runs.durable import make_folders
from jetbot_mjx.runs.run_dir import parse_stored, read_bytes, write_bytes
from jetbot_mjx.runs.trust import trusted_class

FOLDER = "nan_dumps"
"""Name of the folder of dumps in a run folder."""

MAX_DUMPS = 20
"""Largest number of dumps that a run saves; further ones would add no information."""

_MOST_BYTES = 100_000_000
"""Largest size of the arrays of a dump, which a compressed file of any size could ask for."""

_FORMAT = "jetbot_mjx.nan_dump/1"


class StoredNanDump(NamedTuple):
    """A `StoredNanDump` holds a dump that was loaded from a file."""

    config: Config
    env_steps: int
    """Environment steps of the training at the end of the call that found the non-finite state."""
    nan_dump: NanDump
    own_class: type | None = None
    """The class of the task, if its code is stored in the run; None: it is imported by name."""


def save_nan_dump(run_dir: Path, config: Config, env_steps: int, nan_dump: NanDump) -> Path | None:
    """Save a dump to `nan_dumps/<env_steps>.npz`, unless the run already has `MAX_DUMPS` of them.

    Args:
      run_dir: the run folder.
      config: the configuration of the run.
      env_steps: the number of environment steps so far.
      nan_dump: the dump, with arrays on the host.

    Returns:
      The path of the file; None if the dump was not saved.

    Raises:
      OSError: the file cannot be written.
    """
    folder = run_dir / FOLDER
    make_folders(folder)
    path = folder / f"{env_steps:012d}.npz"
    if len(list(folder.glob("*.npz"))) >= MAX_DUMPS and not path.exists():
        return None
    about = {"format": _FORMAT, "config": config.model_dump(mode="json"), "env_steps": env_steps}
    content = io.BytesIO()
    np.savez(content, about=np.array(json.dumps(about)), **flatten(nan_dump))
    write_bytes(path, content.getvalue())
    return path


def load_nan_dump(path: Path) -> StoredNanDump:
    """Load a dump that `save_nan_dump` wrote.

    Args:
      path: the file.

    Returns:
      The dump with its configuration and environment steps.

    Raises:
      NotFoundError: there is no such file.
      InvalidError: `save_nan_dump` did not write it.
      UserError: its run names code that may not run, as for `require_trust`.
    """
    try:
        content = io.BytesIO(read_bytes(path))
        if sum(one.file_size for one in zipfile.ZipFile(content).infolist()) > _MOST_BYTES:
            raise InvalidError(f"{path} holds more than {_MOST_BYTES // 1_000_000} MB")
        with np.load(content, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        about = json.loads(str(arrays.pop("about")))
        if about["format"] != _FORMAT:
            raise InvalidError(f"{path} has the format {shown(about['format'])}, not {_FORMAT!r}")
        run_dir = Path(path).absolute().parent.parent
        config = parse_stored(about["config"], run_dir, "stored config")
        own_class = trusted_class(run_dir, config)
        template = _template(config, own_class)
        wanted = flatten(template)
        if wanted.keys() != arrays.keys():
            odd = sorted(wanted.keys() ^ arrays.keys())[0]
            raise InvalidError(f"{path} does not fit its task: {odd} is missing or unexpected")
        for name, array in arrays.items():
            shape = np.shape(wanted[name])
            if array.shape != shape or array.dtype.kind not in "biuf":
                raise InvalidError(
                    f"{path} does not fit its task: {name} is {array.dtype}{list(array.shape)}, and"
                    f" numbers of the shape {list(shape)} are expected"
                )
        nan_dump = jax.tree.unflatten(
            jax.tree.structure(template), [arrays[name] for name in wanted]
        )
        return StoredNanDump(config, int(about["env_steps"]), nan_dump, own_class)
    except FileNotFoundError:
        raise NotFoundError(f"{path} does not exist: give a file of a run's {FOLDER}/") from None
    except ConfigError as error:
        raise InvalidError(f"{path} cannot be used: {error}") from None
    except UserError:
        raise
    # NumPy reports a foreign file by many kinds of exception, and with advice that does not apply.
    except Exception:
        raise InvalidError(
            f"{path} is not a NaN dump of a training: give a file of a run's {FOLDER}/"
        ) from None


def _template(config: Config, own_class: type | None) -> NanDump:
    """Return the shapes and dtypes of a dump of this configuration."""
    env = envs.wrap_for_training(
        envs.make_env(config, own_class=own_class), config.task.episode_length
    )
    batched = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((1, 2), np.uint32))
    state: State = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), batched)
    return NanDump(
        found=np.bool_(True),  # pyright: ignore[reportArgumentType]
        env_state=state,
        actions=np.zeros((config.ppo.unroll_length, env.action_size)),  # pyright: ignore[reportArgumentType]
        step=np.int32(0),  # pyright: ignore[reportArgumentType]
    )


class ReplayStep(NamedTuple):
    """A `ReplayStep` holds one step of the replay."""

    action: np.ndarray
    state: State
    """State after the step and before any reset."""
    nonfinite: list[str]
    """Names of the arrays that are not finite."""


def replay_nan_dump(stored: StoredNanDump, env: JetBotEnv | AdaptedEnv) -> Iterator[ReplayStep]:
    """Replay the recorded actions from the state in which the unroll began.

    Args:
      stored: The stored state and actions.
      env: The environment that the NaN dump was recorded in.

    Yields:
      Every step up to the one with the non-finite state.
    """
    wrapped = envs.wrap_for_training(env, stored.config.task.episode_length)
    step, raw_step = jax.jit(wrapped.step), jax.jit(jax.vmap(envs.maybe_randomize(env).step))
    state: State = jax.tree.map(lambda x: jnp.asarray(x)[None], stored.nan_dump.env_state)
    for action in stored.nan_dump.actions[: int(stored.nan_dump.step) + 1]:
        after = jax.device_get(jax.tree.map(lambda x: x[0], raw_step(state, action[None])))
        seen = {"pipeline_state": after.pipeline_state, "obs": after.obs, "reward": after.reward}
        nonfinite = [name for name, leaf in flatten(seen).items() if not np.all(np.isfinite(leaf))]
        yield ReplayStep(action, after, nonfinite)
        state = step(state, action[None])


def replay_header(env: JetBotEnv | AdaptedEnv) -> str:
    """Return the names of the columns of `format_step`."""
    if isinstance(env, AdaptedEnv):
        return f"{'step':>4}  {'action':>{8 * env.action_size - 1}}  not finite"
    return (
        f"{'step':>4}  {'action':>15}  {'x [m]':>8} {'y [m]':>8} {'z [m]':>8}  {'yaw':>8}"
        f"  {'max |qvel|':>10}  not finite"
    )


def format_step(index: int, step: ReplayStep) -> str:
    """Return one step as a line of the table; only a robot has a pose."""
    if not isinstance(step.state.pipeline_state, PhysicsState):
        action = " ".join(f"{x:+7.3f}" for x in step.action)
        told = [name.removeprefix("pipeline_state.kept.") for name in step.nonfinite]
        return f"{index:4d}  {action}  {', '.join(told)}"
    robot = envs.robot_state(jax.tree.map(jnp.asarray, step.state.pipeline_state))
    x, y, z = np.asarray(robot.position_w)
    fastest = np.abs(step.state.pipeline_state.qvel).max()
    return (
        f"{index:4d}  {step.action[0]:+7.3f} {step.action[1]:+7.3f}  {x:+8.3f} {y:+8.3f}"
        f" {z:+8.4f}  {math.degrees(float(envs.yaw(robot.quat))):+7.1f}°  {fastest:10.3g}"
        f"  {', '.join(step.nonfinite)}"
    )
