"""The policy spec `policy.json`: all that a program needs to use an exported policy."""

import json

import numpy as np

from jetbot_mjx.config import CameraConfig
from jetbot_mjx.deployment.numpy_policy import Encoder, PortablePolicy
from jetbot_mjx.envs import GOAL_HEIGHT, QPOS_QUAT, QPOS_XYZ, JetBotEnv, Layout, intrinsics
from jetbot_mjx.runs import Checkpoint, JsonObject, read_text, versions

FILE = "policy.json"

FORMAT = "jetbot_mjx-policy/1"
"""The format that `policy.json` names."""

FRAMES = {
    "world": "fixed to the floor, z up; training starts at its origin, heading along x",
    "body": "moves with the robot: axle midpoint, x forward, y left, z up",
}

_VECTORS = ("position", "linear_velocity", "angular_velocity", "goal_position", "goal_direction")
_COMPONENTS = {"quaternion": "wxyz", **dict.fromkeys(_VECTORS, "xyz")}


def policy_spec(checkpoint: Checkpoint, env: JetBotEnv, policy: PortablePolicy) -> JsonObject:
    """Return the spec of a policy, which is the same for every export format.

    Args:
      checkpoint: The checkpoint of the policy.
      env: The environment that the policy was trained in.
      policy: The policy as arrays.

    Returns:
      The spec as JSON; `export` adds the files and the difference of each to JAX.
    """
    config, encoder = checkpoint.config, policy.encoder
    rest = env.mj_model.qpos0
    return {
        "format": FORMAT,
        "run": checkpoint.run_dir.name,
        "env_steps": checkpoint.env_steps,
        "task": config.task.name,
        "robot": config.robot.preset,
        "control_rate": 1.0 / env.dt,
        "control_period": env.dt,
        "inputs": [
            {"name": name, "dtype": str(np.dtype(one.dtype)), "shape": list(one.shape)}
            for name, one in policy.inputs.items()
        ],
        "observation": _observations(env.task.layout),
        **({"image": _image(config.camera, env.dt)} if encoder else {}),
        "action": [
            {"name": "drive", "index": 0, "unit": "1", "low": -1.0, "high": 1.0},
            {"name": "turn", "index": 1, "unit": "1", "low": -1.0, "high": 1.0},
        ],
        "wheel_speeds": _wheel_speeds(policy, env.robot.max_wheel_speed),
        "inside": [
            *(["pixels / 255", "convolutions"] if encoder else []),
            *(["normaliser"] if policy.mean.size else []),
            *("network", "clip to [-1, 1]", "action to wheel speeds"),
        ],
        "outside": [
            *(["resizing the camera's image", "stacking images"] if encoder else []),
            *("limits and dead-band of the motors", "wheel speed to motor value"),
        ],
        "network": {
            **(_sizes(encoder) if encoder else {}),
            "layers": [layer.bias.size for layer in policy.layers],
            "activation": policy.activation,
            "squash": "tanh" if policy.squash else None,
        },
        "frames": FRAMES,
        "success_radius": config.task.success_radius,
        "goal_height": GOAL_HEIGHT,
        "rest_height": float(rest[QPOS_XYZ][2]),
        "rest_quaternion": [float(one) for one in rest[QPOS_QUAT]],
        "episode_seconds": config.task.episode_length * env.dt,
        "evaluation": _evaluation(checkpoint),
        "versions": versions(),
    }


def _wheel_speeds(policy: PortablePolicy, limit: float | None) -> JsonObject:
    """Return how wheel speeds follow from an action; `limit` is that of training [rad/s]."""
    return {
        "order": ["left", "right"],
        "unit": "rad/s",
        "formula": [
            "v = (drive + 1)/2 * max_speed",
            "w = turn * max_yaw_rate",
            "left = (v - w * wheel_separation/2) / wheel_radius",
            "right = (v + w * wheel_separation/2) / wheel_radius",
        ],
        **policy.controller._asdict(),
        "limit_in_training": limit,
    }


def _sizes(encoder: Encoder) -> JsonObject:
    return {
        "convolutions": [
            {"channels": one.bias.size, "side": len(one.kernel), "stride": one.stride}
            for one in encoder.convolutions
        ],
        "features": encoder.dense.bias.size,
    }


def _image(camera: CameraConfig, period: float) -> JsonObject:
    """Return the description of the image, and of the camera that takes it.

    Args:
      camera: the camera section.
      period: the time from one image to the next [s].
    """
    fx, fy, cx, cy = (float(one) for one in intrinsics(camera))
    return {
        "height": camera.height,
        "width": camera.width,
        "channels": ["red", "green", "blue"] if camera.colour == "rgb" else ["grey"],
        "grey": "0.299 red + 0.587 green + 0.114 blue" if camera.colour == "grey" else None,
        "axes": ["row from above", "column from the left", "channel"],
        "dtype": "uint8",
        "range": [0, 255],
        "resize": "area mean: a pixel is the mean of all that it covers of the camera's image",
        "frames": camera.frames,
        "frame_period": period,
        "frame_order": "along the channels, the newest last; a drive begins with copies",
        "stacked_by": "the caller, by stack() of policy.py",
        "camera": {
            "position": list(camera.position),
            "frame": "body",
            "unit": "m",
            "pitch_down_degrees": camera.pitch,
            "lens": camera.lens,
            "matrix": {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "unit": "pixels of the image"},
            "distortion": list(camera.distortion),
            "distortion_order": "OpenCV's",
        },
    }


def _observations(layout: Layout) -> list[JsonObject]:
    found, start = [], 0
    for field in layout:
        components = list(_COMPONENTS.get(field.name, "")[: field.size])
        found.append(
            {
                "name": field.name,
                "index": list(range(start, start + field.size)),
                **({"components": components} if len(components) == field.size else {}),
                "unit": field.unit,
                "frame": field.frame,
            }
        )
        start += field.size
    return found


def _evaluation(checkpoint: Checkpoint) -> JsonObject | None:
    """Return the summary of this checkpoint's report, if `evaluate` wrote one."""
    path = checkpoint.run_dir / "evaluations" / checkpoint.path.name / "report.json"
    try:
        report = json.loads(read_text(path))
        return {"goal_set_version": report["goal_set_version"], **report["policy"]}
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None
