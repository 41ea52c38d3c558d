"""The policy spec `policy.json`: all that a program needs to use an exported policy."""

import json
from pathlib import Path

import numpy as np

from jetbot_mjx.config import CameraConfig, MjcfRobotConfig
from jetbot_mjx.deployment.numpy_policy import (
    CarController,
    Encoder,
    OwnController,
    PortablePolicy,
)
from jetbot_mjx.envs import (
    GOAL_HEIGHT,
    QPOS_QUAT,
    QPOS_XYZ,
    AckermannDrive,
    AdaptedEnv,
    DifferentialDrive,
    JetBotEnv,
    Layout,
    intrinsics,
)
from jetbot_mjx.runs import Checkpoint, JsonObject, read_text, versions

FILE = "policy.json"

_WHEELS_OF_CARS = {
    "order": ["wheel_speed", "curvature"],
    "unit": ["rad/s", "1/m"],
    "formula": [
        "v = (drive + 1)/2 * max_speed",
        "wheel_speed = v / wheel_radius",
        "curvature = turn * max_curvature",
        "angle of a wheel x ahead of the rear axle, y to the left = atan(x * curvature / (1 - y *"
        " curvature))",
        "its speed = wheel_speed * sqrt((1 - y * curvature)^2 + (x * curvature)^2)",
    ],
}
"""What a car's wheels are told, in place of the speeds of two sides."""

_TEMPLATE = Path(__file__).parents[1] / "assets" / "policy_spec.json"
"""The keys in their order, and the values that are the same for every policy."""

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
    spec = _template()
    # Describe what belongs to an image, or leave it out.
    if encoder:
        spec["image"] = _image(config.camera, env.dt)
        spec["inside"] = ["pixels / 255", "convolutions", *spec["inside"]]
        spec["outside"] = ["resizing the camera's image", "stacking images", *spec["outside"]]
    else:
        del spec["image"]
    if policy.mean.size:
        spec["inside"].insert(-3, "normaliser")
    # Fill in what differs between policies; the limit of wheel speeds is in rad/s.
    _describe_drive(spec, policy, env)
    if isinstance(config.robot, MjcfRobotConfig):
        spec["frames"]["body"] = "that of the base in its model: x forward, y left, z up"
    return spec | {
        "run": checkpoint.run_dir.name,
        "env_steps": checkpoint.env_steps,
        "task": config.task.name,
        "robot": config.robot.model_dump(mode="json"),
        "control_rate": 1.0 / env.dt,
        "control_period": env.dt,
        "inputs": _inputs(policy),
        "observation": _observations(env.task.layout),
        "network": _network(policy),
        "success_radius": config.task.success_radius,
        "goal_height": GOAL_HEIGHT,
        "rest_height": float(rest[QPOS_XYZ][2]),
        "rest_quaternion": [float(one) for one in rest[QPOS_QUAT]],
        "episode_seconds": config.task.episode_length * env.dt,
        "evaluation": _evaluation(checkpoint),
        "versions": versions(),
    }


def environment_spec(checkpoint: Checkpoint, env: AdaptedEnv, policy: PortablePolicy) -> JsonObject:
    """Return the spec of a policy of an environment of one's own, as `policy_spec` does.

    Args:
      checkpoint: The checkpoint of the policy.
      env: The environment that the policy was trained in.
      policy: The policy as arrays.
    """
    config, template = checkpoint.config, _template()
    low, what = (0.0, "choice") if policy.is_choice else (-1.0, "action")
    last = "1 at the largest output, 0 elsewhere" if policy.is_choice else "clip to [-1, 1]"
    return {
        "format": template["format"],
        "run": checkpoint.run_dir.name,
        "env_steps": checkpoint.env_steps,
        "environment": config.environment,
        "environment_options": config.environment_options,
        "control_rate": None if env.dt is None else 1.0 / env.dt,
        "control_period": env.dt,
        "inputs": _inputs(policy),
        "observation": _observations(env.layout),
        "action": [
            {"name": f"{what}_{i}", "index": i, "unit": "1", "low": low, "high": 1.0}
            for i in range(env.action_size)
        ],
        "inside": ["normaliser", "network", last],
        "outside": ["what the environment makes of an action"],
        "network": _network(policy),
        "episode_steps": config.task.episode_length,
        "evaluation": _evaluation(checkpoint),
        "versions": versions(),
    }


def _inputs(policy: PortablePolicy) -> list[JsonObject]:
    return [
        {"name": name, "dtype": str(np.dtype(one.dtype)), "shape": list(one.shape)}
        for name, one in policy.inputs.items()
    ]


def _network(policy: PortablePolicy) -> JsonObject:
    return {
        **(_sizes(policy.encoder) if policy.encoder else {}),
        "layers": [layer.bias.size for layer in policy.layers],
        "activation": policy.activation,
        "squash": "tanh" if policy.squash else None,
    }


def _describe_drive(spec: JsonObject, policy: PortablePolicy, env: JetBotEnv) -> None:
    """Add what the action means, and of a robot's own model which actuator does what."""
    if isinstance(policy.controller, CarController):
        spec["wheel_speeds"] |= _WHEELS_OF_CARS
    if isinstance(policy.controller, OwnController):
        spec["action"] = [
            {"name": f"action_{i}", "index": i, "unit": "1", "low": -1.0, "high": 1.0}
            for i in range(policy.controller.action_size)
        ]
        spec["wheel_speeds"] = {"order": [one["name"] for one in spec["action"]], "unit": "1"}
    assert policy.controller
    spec["wheel_speeds"] |= policy.controller._asdict()
    spec["wheel_speeds"]["limit_in_training"] = env.robot.max_wheel_speed
    if actuators := _actuators(env):
        spec["actuators"] = actuators


def _actuators(env: JetBotEnv) -> list[JsonObject]:
    """Return which wheel each actuator of a robot's own model has; none of a JetBot."""
    drive, wheels = env.drive, []
    if isinstance(drive, AckermannDrive):
        wheels = [*(("angle", one) for one in drive.steered), *(("speed", x) for x in drive.driven)]
    elif isinstance(drive, DifferentialDrive):
        wheels = [("speed", one) for one in drive.wheels]
    return [
        {
            "name": env.mj_model.actuator(one.actuator).name.rpartition("/")[2],
            "index": one.actuator,
            "control": what,
            "gain": one.gain,
            "x": one.x,
            "y": one.y,
        }
        for what, one in wheels
    ]


def _sizes(encoder: Encoder) -> JsonObject:
    return {
        "convolutions": [
            {"channels": one.bias.size, "side": len(one.kernel), "stride": one.stride}
            for one in encoder.convolutions
        ],
        "features": encoder.dense.bias.size,
    }


def _template() -> JsonObject:
    return json.loads(_TEMPLATE.read_text(encoding="utf-8"))


def _image(camera: CameraConfig, period: float) -> JsonObject:
    """Return the description of the image, and of the camera that takes it.

    Args:
      camera: the camera section.
      period: the time from one image to the next [s].
    """
    image, is_grey = _template()["image"], camera.colour == "grey"
    image |= {
        "height": camera.height,
        "width": camera.width,
        "channels": ["grey"] if is_grey else ["red", "green", "blue"],
        "grey": "0.299 red + 0.587 green + 0.114 blue" if is_grey else None,
        "frames": camera.frames,
        "frame_period": period,
    }
    image["camera"] |= {
        "position": list(camera.position),
        "pitch_down_degrees": camera.pitch,
        "lens": camera.lens,
        "distortion": list(camera.distortion),
    }
    focal = zip(("fx", "fy", "cx", "cy"), intrinsics(camera), strict=True)
    image["camera"]["matrix"] |= {name: float(one) for name, one in focal}
    return image


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
