"""Render the clips of a report: short, small and muted."""

import math
from collections.abc import Sequence

import jax
import numpy as np

from jetbot_mjx.envs import JetBotEnv
from jetbot_mjx.evaluation import Clip, Episodes
from jetbot_mjx.viewers.video import FPS, VideoRenderer, encode_mp4, split_trajectories

_SIZE = (384, 216)
_FPS = FPS / 2
_LONGEST_SECONDS = 3.5  # of a clip in real time; longer ones are faster


def make_clips(env: JetBotEnv, episodes: Episodes, goals: Sequence[int]) -> list[Clip]:
    """Render some episodes of a batch, each as a clip of a few seconds.

    Args:
      env: the environment of the episodes.
      episodes: the batch, on the host, recorded with `qpos`.
      goals: the indices of the episodes in the batch, which are those of their goals.

    Raises:
      UserError: this machine has no OpenGL that works without a display.
    """
    chosen = jax.tree.map(lambda leaf: np.asarray(leaf)[np.asarray(goals)], episodes)
    clips = []
    with VideoRenderer(env, _SIZE, _FPS, shadows=False) as renderer:
        for one in split_trajectories(env, chosen, goals):
            speed = max(1, math.ceil(one.steps * one.dt / _LONGEST_SECONDS))
            frames = renderer.render_episode(one, speed)
            clips.append(Clip(one.goal_number, one.reached, speed, encode_mp4(frames, _FPS)))
    return clips
