"""Arguments, seeds and optional packages, checked before anything is built."""

import contextlib
import math
import numbers
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt32

from jetbot_mjx.adapters.renderer import RENDER_MODES, FrameRenderer, shown_here
from jetbot_mjx.config import Config, load_config, parse_config
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.errors import UserError

Seed = int | Sequence[int | None] | None
Source = Config | Mapping[str, Any] | str | Path | None
"""A configuration, nested settings, a YAML file, or None for the tutorial's."""

_MOST_ENVS = 2**24


@contextlib.contextmanager
def an_extra(extra: str) -> Iterator[None]:
    """Say in one line how to install what is imported inside.

    Args:
      extra: of this project, which brings it.

    Raises:
      UserError: it is not there.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise UserError(
            f"{error.name} is missing: pip install 'jetbot_mjx[{extra}]', from a checkout"
            f" '.[{extra}]'"
        ) from None


class Arguments(NamedTuple):
    """The tutorial's arguments, which the adapters' constructors take by the same names."""

    skip_frame: int = 1
    physics_dt: float | None = None
    rendering_dt: float | None = None
    max_episode_length: int | None = None
    headless: bool = True
    render_mode: str | None = None


class Settings(NamedTuple):
    """The configuration and the view that the arguments resolve to."""

    config: Config
    render_mode: str | None
    rendering_dt: float
    """[s] between two pictures in a window."""

    @property
    def metadata(self) -> dict[str, Any]:
        """Return what an environment declares: render modes available here, images per second."""
        modes = [mode for mode in RENDER_MODES if mode == self.render_mode or shown_here(mode)]
        return {
            "render_modes": modes,
            "render_fps": max(1, round(1 / self.config.physics.ctrl_dt)),
        }

    def view(self, env: JetBotEnv) -> FrameRenderer | None:
        """Return what shows an environment; None where nothing is to be shown.

        Raises:
          UserError: there is no display for a window.
        """
        return FrameRenderer(env, self.render_mode, self.rendering_dt) if self.render_mode else None


def resolve(given: Arguments, config: Source) -> Settings:
    """Work the tutorial's arguments into a configuration.

    Args:
      given: the arguments; None leaves a setting as the configuration has it.
      config: a configuration, as nested settings, as a YAML file, or None for the tutorial's.

    Returns:
      The configuration that the environment is built from, and how it shows itself.

    Raises:
      UserError: an argument is out of bounds, or the configuration cannot be read.
    """
    base = _read(config)
    physics_dt = base.physics.ctrl_dt if given.physics_dt is None else given.physics_dt
    length = given.max_episode_length
    length = base.task.episode_length if length is None else length
    _check_count("skip_frame", given.skip_frame)
    _check_count("max_episode_length", length)
    _check_seconds("physics_dt", physics_dt)
    ctrl_dt = given.skip_frame * physics_dt
    rendering_dt = ctrl_dt if given.rendering_dt is None else given.rendering_dt
    _check_seconds("rendering_dt", rendering_dt)
    mode = given.render_mode or (None if given.headless else "human")
    if mode not in (None, *RENDER_MODES):
        raise UserError(f"render_mode = {mode!r} is unknown: known are {', '.join(RENDER_MODES)}")
    values = base.model_dump()
    # As many physics steps in every frame as it takes to make none longer than the configuration's,
    # give or take what a configuration may round.
    substeps = given.skip_frame * math.ceil(physics_dt / base.physics.sim_dt * (1 - 1e-3))
    values["physics"] |= {"ctrl_dt": float(ctrl_dt), "sim_dt": ctrl_dt / substeps}
    values["task"]["episode_length"] = int(length)
    return Settings(parse_config(values), mode, rendering_dt)


def _read(config: Source) -> Config:
    match config:
        case Config():
            return config
        case None:
            return Config()
        case Mapping():
            return parse_config(config)
        case str() | Path():
            return load_config(config)
    raise UserError(f"config = {config!r} is wrong: give a YAML file, a mapping or a Config")


def _check_count(name: str, value: Any) -> None:
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
        raise UserError(f"{name} = {value!r} is wrong: it should be a whole number from 1 on")


def _check_seconds(name: str, value: Any) -> None:
    if not isinstance(value, numbers.Real) or not 0 < float(value) < math.inf:
        raise UserError(f"{name} = {value!r} is wrong: it should be seconds above 0")


def check_num_envs(num_envs: Any) -> int:
    """Refuse what is no number of environments.

    Args:
      num_envs: how many environments are asked for.

    Returns:
      The same.

    Raises:
      UserError: it is none.
    """
    _check_count("num_envs", num_envs)
    if num_envs > _MOST_ENVS:
        raise UserError(f"num_envs = {num_envs} is wrong: it should be at most {_MOST_ENVS}")
    return int(num_envs)


def as_actions(actions: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Return actions as an array, and refuse what has another shape.

    Args:
      actions: numbers in [-1, 1]; values outside are clipped where they are used.
      shape: (2,) for one robot, (n, 2) for a batch.

    Raises:
      UserError: they are no numbers, or not of that shape.
    """
    try:
        # What is too large for float32 is clipped later, as infinity is.
        with np.errstate(over="ignore"):
            found = np.asarray(actions, np.float32)
    except (TypeError, ValueError):
        raise UserError(f"action = {actions!r} is wrong: it should be numbers {shape}") from None
    if found.shape != shape:
        raise UserError(f"action has the shape {found.shape}: it should be {shape}")
    return found


def key_from_seed(seed: int | None) -> UInt32[np.ndarray, "2"]:
    """Return the random key that a robot's episodes come from.

    Args:
      seed: a whole number from 0 on; None: something else every time.

    Returns:
      A legacy key, as `JetBotEnv.reset` takes it.
    """
    return np.random.default_rng(seed).integers(2**32, size=2, dtype=np.uint32)


def seeds_of(seed: Seed, num_envs: int) -> list[int | None]:
    """One seed for each environment, by Gymnasium's rule: one number counts on from there.

    Args:
      seed: one number, one for each environment, or None.
      num_envs: how many environments there are.

    Returns:
      As many seeds, or Nones.

    Raises:
      UserError: there are more or fewer seeds than environments, or one is no seed.
    """
    if seed is None:
        return [None] * num_envs
    if not isinstance(seed, Sequence):
        _check_seed(seed)
        return [int(seed) + index for index in range(num_envs)]
    if len(seed) != num_envs:
        raise UserError(f"seed has {len(seed)} numbers: give one, or one for each of {num_envs}")
    for one in seed:
        if one is not None:
            _check_seed(one)
    return list(seed)


def _check_seed(seed: Any) -> None:
    if not isinstance(seed, numbers.Integral) or int(seed) < 0:
        raise UserError(f"seed = {seed!r} is wrong: it should be a whole number from 0 on")
