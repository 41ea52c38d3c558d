"""The clips of a report, on episodes made by hand."""

import io

import imageio.v3 as iio
import jax
import numpy as np

from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.viewers import clips, video


def episodes_of(env, steps, success):
    goal = np.asarray(jax.vmap(env.task.sample)(report_keys(len(steps))))
    qpos = np.tile(env.mj_model.qpos0, (len(steps), 1 + max(steps), 1))
    qpos[:, :, 0] = np.linspace(0, 0.5, qpos.shape[1])
    zeros = np.zeros(len(steps))
    return Episodes(
        success=np.array(success),
        steps=np.array(steps, float),
        episode_return=zeros,
        terminated=zeros,
        nonfinite=zeros,
        path_length=zeros,
        start_w=np.zeros((len(steps), 2)),
        start_yaw=zeros,
        end_w=qpos[:, -1, :2],
        goal_w=goal,
        goal=goal,
        qpos=qpos,
    )


def test_clips_are_short_and_small(world_env, with_opengl):
    episodes = episodes_of(world_env, [30, 60, 480], [1.0, 1.0, 0.0])
    first, second = clips.make_clips(world_env, episodes, [1, 2])
    assert (first.goal, first.reached, first.speed) == (1, True, 1)
    assert (second.goal, second.reached, second.speed) == (2, False, 3)
    for clip, seconds in ((first, 1.0), (second, 8.0 / 3)):
        frames = iio.imread(io.BytesIO(clip.mp4), plugin="pyav", extension=".mp4")
        assert frames.shape[1:] == (216, 384, 3)
        expected = (seconds + video.HOLD_SECONDS) * clips._FPS
        assert abs(len(frames) - expected) <= 3
        assert len(clip.mp4) < 200_000
