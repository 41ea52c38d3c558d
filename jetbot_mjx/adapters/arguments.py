"""Check the adapters' arguments, seeds, actions and optional packages before anything is built."""

import math
import numbers
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt32

from jetbot_mjx.adapters.renderer import RENDER_MODES
from jetbot_mjx.config import Config, load_config, parse_config
from jetbot_mjx.errors import UserError, check_count

Seed = int | Sequence[int | None] | None
Source = Config | Mapping[str, object] | str | Path | None
"""A configuration, nested settings, a YAML file, or None for the tutorial's configuration."""


TutorialArguments = tuple[int, float | None, float | None, int | None, bool, str | None]
"""skip_frame, physics_dt, rendering_dt, max_episode_length, headless and render_mode of the
tutorial's constructor, which `JetBotGymEnv` documents."""


def resolve(config: Source, given: TutorialArguments) -> tuple[Config, str | None, float]:
    """Apply the tutorial's arguments to a configuration.

    Args:
      config: The configuration.
      given: The arguments; None leaves a setting as it is in the configuration.

    Returns:
      The configuration to build the environment from, the render mode, and the simulated time
      between two frames in a window [s].

    Raises:
      UserError: An argument is out of bounds, or the configuration cannot be read.
    """
    # Check each argument, with the configuration's value where none is given.
    base = _read(config)
    skip_frame, physics_dt, rendering_dt, max_episode_length, headless, render_mode = given
    physics_dt = base.physics.ctrl_dt if physics_dt is None else physics_dt
    length = base.task.episode_length if max_episode_length is None else max_episode_length
    check_count("skip_frame", skip_frame)
    check_count("max_episode_length", length)
    _check_seconds("physics_dt", physics_dt)
    ctrl_dt = skip_frame * physics_dt
    rendering_dt = ctrl_dt if rendering_dt is None else rendering_dt
    _check_seconds("rendering_dt", rendering_dt)
    mode = render_mode or (None if headless else "human")
    if mode not in (None, *RENDER_MODES):
        raise UserError(f"render_mode = {mode!r} is unknown: known are {', '.join(RENDER_MODES)}")

    # Divide each frame into the fewest physics steps that are no longer than the configuration's;
    # the tolerance is that of a configuration with rounded numbers.
    substeps = skip_frame * math.ceil(physics_dt / base.physics.sim_dt * (1 - 1e-3))
    values = base.model_dump()
    values["physics"] |= {"ctrl_dt": float(ctrl_dt), "sim_dt": ctrl_dt / substeps}
    values["task"]["episode_length"] = int(length)
    return parse_config(values), mode, rendering_dt


def _read(config: Source) -> Config:
    match config:
        case Config():
            return config
        case Mapping():
            return parse_config(config)
        case None | str() | Path():
            return load_config(config)
    raise UserError(f"config = {config!r} is wrong: give a YAML file, a mapping or a Config")


def _check_seconds(name: str, value: object) -> None:
    if not isinstance(value, numbers.Real) or not 0 < float(value) < math.inf:
        raise UserError(f"{name} = {value!r} is wrong: it should be seconds above 0")


def as_actions(actions: object, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Return actions as a float32 array of the expected shape.

    Args:
      actions: Numbers in [-1, 1]; values outside are clipped where they are used.
      shape: (2,) for one robot, (n, 2) for a batch.

    Raises:
      UserError: The actions are not numbers, or have another shape.
    """
    try:
        # What is too large for float32 becomes infinite here, and is clipped later.
        with np.errstate(over="ignore"):
            found = np.asarray(actions, np.float32)
    except (TypeError, ValueError):
        raise UserError(f"action = {actions!r} is wrong: it should be numbers {shape}") from None
    if found.shape != shape:
        raise UserError(f"action has the shape {found.shape}: it should be {shape}")
    return found


def key_from_seed(seed: int | None) -> UInt32[np.ndarray, "2"]:
    """Return the random key of a robot's first episode, as `JetBotEnv.reset` takes it.

    Args:
      seed: A whole number from 0 on; None draws another key in every call.
    """
    return np.random.default_rng(seed).integers(2**32, size=2, dtype=np.uint32)


class ResetKeys:
    """The rule for the key of each environment's next episode.

    A seed of this reset comes first. Without one an environment continues its own random stream,
    and before its first episode it takes the constructor's seed.
    """

    def __init__(self, seed: Seed, num_envs: int) -> None:
        """Store the constructor's seeds.

        Raises:
          UserError: There are more or fewer seeds than environments, or one is not a seed.
        """
        self._first = _seeds(seed, num_envs)

    def __call__(
        self, seed: Seed, current: UInt32[np.ndarray, "n 2"] | None
    ) -> UInt32[np.ndarray, "n 2"]:
        """Return the keys of the next episodes.

        Args:
          seed: One number, which counts on from environment to environment as in Gymnasium, one
            for each environment, or None.
          current: The keys with which the environments continue; None before their first episode.

        Raises:
          UserError: There are more or fewer seeds than environments, or one is not a seed.
        """
        seeds = _seeds(seed, len(self._first))
        if current is None:
            pairs = zip(seeds, self._first, strict=True)
            return np.stack([key_from_seed(first if one is None else one) for one, first in pairs])
        pairs = zip(seeds, current, strict=True)
        return np.stack([key if one is None else key_from_seed(one) for one, key in pairs])


def _seeds(seed: Seed, num_envs: int) -> list[int | None]:
    """Return one seed, or None, for each environment."""
    each = list(seed) if isinstance(seed, Sequence) else [seed] * num_envs
    if len(each) != num_envs:
        raise UserError(f"seed has {len(each)} numbers: give one, or one for each of {num_envs}")
    for one in each:
        if one is not None and (not isinstance(one, numbers.Integral) or int(one) < 0):
            raise UserError(f"seed = {one!r} is wrong: it should be a whole number from 0 on")
    if seed is None or isinstance(seed, Sequence):
        return each
    return [int(seed) + index for index in range(num_envs)]
