"""Render episodes in an environment of one's own that has a model of MuJoCo."""

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.agents import PolicyParams
from jetbot_mjx.envs import AdaptedEnv
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import ReturnEpisodes, ReturnEvaluator, report_keys
from jetbot_mjx.runs import Setup
from jetbot_mjx.viewers.offscreen import Renderer
from jetbot_mjx.viewers.video import (
    FPS,
    GIF_STRIDE,
    HOLD_SECONDS,
    MISSED,
    REACHED,
    SIZE,
    Frame,
    with_lines,
    write_gif,
    write_mp4,
)

_DISTANCE = 1.5  # of a camera that follows, in the model's extents
_TEXT, _MARGIN = 0.04, 0.03  # of the height


class Motion(NamedTuple):
    """A `Motion` holds one recorded episode, on the host."""

    number: int
    """Index of its start in the report's fixed starts."""
    qpos: Float[np.ndarray, "time nq"]
    """Generalised positions from the first state to the last."""
    episode_return: float
    success: bool | None
    """None: the environment tells no success."""


def require_model(env: AdaptedEnv) -> mujoco.MjModel:
    """Return the model of MuJoCo that pictures are rendered from.

    Raises:
      UserError: the environment has none.
    """
    if (model := env.mj_model) is None:
        raise UserError(
            f"environment = {env.config.environment!r} cannot be rendered: it has no `mj_model`, or"
            " its state no `qpos`"
        )
    return model


def split_motions(env: AdaptedEnv, episodes: ReturnEpisodes) -> list[Motion]:
    """Split a batch of recorded episodes, those of the report's first starts.

    Args:
      env: the environment of the episodes.
      episodes: the batch, recorded with `qpos`.
    """
    host = jax.device_get(episodes)
    return [
        Motion(
            number=index,
            qpos=host.qpos[index, : int(steps) + 1],
            episode_return=float(host.episode_return[index]),
            success=bool(host.success[index] > 0) if env.has_success else None,
        )
        for index, steps in enumerate(host.steps)
    ]


class EnvironmentRenderer(contextlib.ExitStack):
    """An `EnvironmentRenderer` renders motions in real time; it is a context manager.

    The view is that of the model's first camera, or of one that follows the first body.
    """

    def __init__(self, env: AdaptedEnv, size: tuple[int, int] = SIZE, fps: float = FPS) -> None:
        """Open the renderer.

        Args:
          env: the environment of the motions.
          size: the width and height of a frame [pixels].
          fps: frames per second.

        Raises:
          UserError: it has no model, or this machine has no OpenGL that works without a display.
        """
        super().__init__()
        model = require_model(env)
        self._dt = env.dt or float(model.opt.timestep)
        self._camera = view_of(model)
        (width, height), self._fps = size, fps
        self._height = height
        self._view = self.enter_context(Renderer(model, width=width, height=height))

    def frame_count(self, motion: Motion) -> int:
        """Return the number of frames of a video of one motion, with a pause at its end."""
        seconds = (len(motion.qpos) - 1) * self._dt
        return math.ceil(seconds * self._fps) + round(HOLD_SECONDS * self._fps) + 1

    def render_episode(self, motion: Motion) -> Iterator[Frame]:
        """Render one motion.

        Args:
          motion: the episode.
        """
        last = len(motion.qpos) - 1
        margin = round(_MARGIN * self._height)
        for frame in range(self.frame_count(motion)):
            step = min(round(frame / self._fps / self._dt), last)
            lines = [(f"start {motion.number}   {step * self._dt:.2f} s", "white")]
            if step == last:
                lines.append((f"return {motion.episode_return:.1f}", "white"))
            if step == last and motion.success is not None:
                told = ("success", REACHED) if motion.success else ("no success", MISSED)
                lines.append(told)
            image = self._view.frame(motion.qpos[step], {}, self._camera)
            yield with_lines(image, lines, _TEXT * self._height, margin)


class EnvironmentVideo:
    """An `EnvironmentVideo` renders policies of a training from the report's first start."""

    _SIZE, _FPS = (320, 240), FPS / GIF_STRIDE  # small, so that training waits only briefly

    def __init__(self, setup: Setup) -> None:
        """Prepare the program, which compiles at its first use.

        Args:
          setup: the environment, networks and programs of the training.

        Raises:
          UserError: the environment has no model.
        """
        assert isinstance(setup.env, AdaptedEnv)
        require_model(setup.env)
        self._env = setup.env
        self._evaluator = ReturnEvaluator(setup.env, setup.networks, setup.programs, record=True)

    def write(self, path: Path, params: PolicyParams, env_steps: int) -> None:
        """Run an episode and write its video, and a GIF of the same name.

        Args:
          path: the path of the mp4 file.
          params: the parameters of the policy.
          env_steps: the environment steps that the policy was trained for.

        Raises:
          UserError: this machine has no OpenGL that works without a display.
        """
        (motion,) = split_motions(self._env, self._evaluator.run(params, report_keys(1)))
        with EnvironmentRenderer(self._env, self._SIZE, self._FPS) as renderer:
            frames = list(renderer.render_episode(motion))
        write_mp4(path, frames, self._FPS)
        write_gif(path.with_suffix(".gif"), frames)


def view_of(model: mujoco.MjModel) -> mujoco.MjvCamera:
    """Return a model's first camera, or one that follows its first body.

    Args:
      model: the model.
    """
    camera = mujoco.MjvCamera()
    if model.ncam:
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        return camera
    mujoco.mjv_defaultFreeCamera(model, camera)
    # Of the bodies that move, the first is the root.
    moving = np.flatnonzero(model.body_dofnum > 0)
    if moving.size:
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, int(moving[0])
        camera.distance = _DISTANCE * model.stat.extent
    return camera
