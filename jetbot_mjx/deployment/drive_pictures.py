"""Show what the camera of a logged drive saw, above what the simulated robot sees."""

import base64
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jetbot_mjx.config import PhysicsConfig, RobotConfig
from jetbot_mjx.deployment.simulated_camera import camera_config
from jetbot_mjx.envs import GOAL_HEIGHT, QPOS_QUAT, QPOS_XYZ, Camera, make_mj_model, turned
from jetbot_mjx.runs import JsonObject

SHOWN = 8
"""Largest number of pictures in a strip."""


class LoggedPicture(NamedTuple):
    """A `LoggedPicture` holds an image that a drive was made by."""

    time: float
    """Since the start of the drive [s]."""
    image: UInt8[np.ndarray, "h w 3"]


def read_picture(header: JsonObject, period: JsonObject, time: float) -> LoggedPicture | None:
    """Return the picture of a control period; None: it has none.

    Args:
      header: the first line of the log.
      period: the line of the period.
      time: its time [s].

    Raises:
      ValueError: the picture has another size than the header says.
    """
    if "picture" not in period:
        return None
    flat = np.frombuffer(base64.b64decode(period["picture"]), np.uint8)
    image = header["image"]
    return LoggedPicture(time, flat.reshape(image["height"], image["width"], 3))


def picture_strip(
    header: JsonObject,
    pictures: Sequence[LoggedPicture],
    times: Float[np.ndarray, " m"],
    simulated: Float[np.ndarray, "m 3"],
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return up to `SHOWN` logged pictures side by side.

    Where the log says where the cube stood, a second row shows what the simulated robot sees at
    the same times, by the renderer of training.

    Args:
      header: the first line of the log.
      pictures: at least one logged picture.
      times: times of the simulated poses [s].
      simulated: poses (x, y, yaw) [m, m, rad] of the simulated robot.
    """
    chosen = np.unique(np.linspace(0, len(pictures) - 1, SHOWN).round().astype(int))
    shown = [pictures[index] for index in chosen]
    rows = [np.concatenate([one.image for one in shown], axis=1)]
    if header["goal"] is not None:
        at = [np.interp([one.time for one in shown], times, column) for column in simulated.T]
        images = _simulated_images(header["image"], np.stack(at, axis=-1), header["goal"])
        rows.append(np.concatenate(list(images), axis=1))
    return np.concatenate(rows)


def _simulated_images(
    image: JsonObject, poses: Float[np.ndarray, "n 3"], goal: Sequence[float]
) -> UInt8[np.ndarray, "n h w 3"]:
    model = make_mj_model(RobotConfig(preset="real"), PhysicsConfig())
    size = {"width": image["width"], "height": image["height"]}
    camera = Camera(camera_config(image).model_copy(update=size), model)
    rest = jnp.asarray(model.qpos0, jnp.float32)
    cube = jnp.array([*goal, GOAL_HEIGHT], jnp.float32)

    def see(pose: Float[Array, "3"]) -> UInt8[Array, "h w 3"]:
        position = jnp.stack([pose[0], pose[1], rest[QPOS_XYZ][2]])
        quat = turned(rest[QPOS_QUAT], pose[2])
        return camera.render(camera.pose(position, quat), {"goal": cube})

    return np.asarray(jax.jit(jax.vmap(see))(jnp.asarray(poses, jnp.float32)))
