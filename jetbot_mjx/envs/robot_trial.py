"""Drive a robot in C MuJoCo, before it is trained.

A model that compiles may still not drive: a wheel is in the air, the motors are unstable at the
time step, or too weak. A trial takes a moment and finds out.
"""

import copy
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.config import Config
from jetbot_mjx.devices import default_device_cpu
from jetbot_mjx.envs.drive import AckermannDrive, DifferentialDrive, Drive, OwnDrive
from jetbot_mjx.envs.robot_model import QPOS_XYZ, QVEL_ANGULAR_B
from jetbot_mjx.errors import UserError

_SECONDS = 2.0  # [s] of a trial, of which the second half is measured
_SLOWEST, _FASTEST = 0.3, 3.0  # of the commanded speed
_LEAST_TURN = 0.02  # of the commanded turn
_CURVE = (-0.6, 0.5)
"""Action of the curve: a fifth of the speed, and half of the largest turn."""
_LEAST_FRICTION = 1e-3
"""Sliding friction below which MuJoCo's pyramidal cone is too stiff to be solved."""
_HOLD = 0.25  # [s] for which the trial of the motors holds a command


class Trial(NamedTuple):
    """A `Trial` holds how a robot follows its commands."""

    speed: float
    """Speed straight ahead as a share of the commanded one."""
    turn: float
    """Yaw rate, or curvature of a car's path, as a share of the commanded one, in a slow curve."""
    veer: float
    """Yaw rate straight ahead [rad/s]: 0 of a robot whose sides are alike."""


def drive_trial(config: Config, model: mujoco.MjModel, drive: Drive) -> Trial | None:
    """Drive straight ahead, in a curve, and by commands that switch from limit to limit.

    Args:
      config: the configuration.
      model: the compiled scene, with the robot.
      drive: the robot's drive.

    Returns:
      How the robot follows its commands; None where only its own function knows what they mean.

    Raises:
      UserError: the robot is unstable, a driven wheel does not touch the floor, or the robot does
        not follow.
    """
    if not isinstance(drive, OwnDrive):
        _check_touch(config, model, drive)
    _check_stable(config, model, drive)
    if isinstance(drive, OwnDrive):
        return None
    ahead = _hold(model, drive, (1.0, 0.0))
    half = len(ahead) // 2
    speed = float((ahead[-1, 0] - ahead[half, 0]) / (_SECONDS - half * model.opt.timestep))
    share = speed / config.task.max_speed
    if not _SLOWEST < share < _FASTEST:
        raise _error(
            config,
            f"told to drive ahead with task.max_speed = {config.task.max_speed:g} m/s, it drives"
            f" with {speed:.3g} m/s: the motors are too weak or too slow, the wheels slip, or"
            " something holds it, such as a part that drags on the floor, a joint's damping or an"
            " equality",
        )
    turn = trial_turn(model, drive)
    if turn < _LEAST_TURN:
        raise _error(
            config,
            f"told to turn half as fast as it may, it turns {turn:.2g} times as fast: a joint or"
            " another part holds it, or the wheels are too far apart for their grip",
        )
    return Trial(share, turn, float(ahead[half:, 2].mean()))


def trial_turn(model: mujoco.MjModel, drive: DifferentialDrive | AckermannDrive) -> float:
    """Return the yaw rate, or of a car the curvature, as a share of the commanded one.

    Args:
      model: the compiled scene, with the robot.
      drive: the robot's drive.
    """
    curve = _hold(model, drive, _CURVE)
    half = len(curve) // 2
    rate = float(curve[half:, 2].mean())
    if not isinstance(drive, AckermannDrive):
        return rate / (0.5 * drive.max_yaw_rate)
    length = np.linalg.norm(np.diff(curve[half:, :2], axis=0), axis=1).sum()
    turned = rate * (_SECONDS - half * model.opt.timestep)
    return float(turned / length / (0.5 * drive.max_curvature))


def _hold(
    model: mujoco.MjModel, drive: Drive, action: tuple[float, float]
) -> Float[np.ndarray, "t 3"]:
    """Return (x, y, yaw rate) of a robot that holds an action, and is known to be stable."""
    steps = round(_SECONDS / model.opt.timestep)
    path = _run(model, np.tile(_controls(drive, np.array([action])), (steps, 1)))
    assert path is not None
    return path


def _check_stable(config: Config, model: mujoco.MjModel, drive: Drive) -> None:
    """Check that the robot stays finite under commands that switch from limit to limit."""
    count = round(2 * _SECONDS / _HOLD)
    limits = np.random.default_rng(0).choice([-1.0, 1.0], (count, drive.action_size))
    held = round(_HOLD / model.opt.timestep)
    switching = _controls(drive, limits)
    if not np.all(np.isfinite(switching)):
        action = limits[np.flatnonzero(~np.isfinite(switching).all(axis=1))[0]].tolist()
        raise _error(
            config, f"its drive gives a control that is not finite for the action {action}"
        )
    path = _run(model, np.repeat(switching, held, axis=0))
    if path is None:
        raise _error(
            config,
            f"it is unstable with physics.sim_dt = {model.opt.timestep:g} under commands that"
            " switch: make that shorter, the actuators' gains smaller, or the joints' armature"
            " larger",
        )


def _controls(drive: Drive, actions: Float[np.ndarray, "n action"]) -> Float[np.ndarray, "n nu"]:
    """Return the controls of actions."""
    # Of a JAX on a GPU, each of these few operations would wait for the device.
    with default_device_cpu():
        one = jax.jit(jax.vmap(lambda action: drive.controls(drive.command(action))))
        return np.asarray(one(jnp.asarray(actions, jnp.float32)), float)


def _error(config: Config, reason: str) -> UserError:
    return UserError(f"robot {config.robot.label}: {reason}")


def _check_touch(
    config: Config, model: mujoco.MjModel, drive: DifferentialDrive | AckermannDrive
) -> None:
    """Check that each driven wheel touches the floor at rest."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    floor = model.geom("floor").id
    touching = {model.geom_bodyid[x] for pair in data.contact.geom if floor in pair for x in pair}
    for contact in data.contact:
        if contact.dim > 1 and contact.friction[0] < _LEAST_FRICTION:
            geom = model.geom(max(contact.geom)).name.rpartition("/")[2] or "a geom"
            raise _error(
                config,
                f"{geom} touches the floor with a friction of {contact.friction[0]:g}: give"
                f' {_LEAST_FRICTION:g} or more, or condim="1" to what should slide freely',
            )
    wheels = drive.driven if isinstance(drive, AckermannDrive) else drive.wheels
    for wheel in wheels:
        joint = model.actuator_trnid[wheel.actuator, 0]
        body = model.jnt_bodyid[joint]
        if body not in touching:
            gap = data.xpos[body, 2] - wheel.radius
            name = model.actuator(wheel.actuator).name.rpartition("/")[2]
            raise _error(
                config,
                f"the wheel of {name} does not touch the floor where the robot rests:"
                f" it is {1e3 * gap:.3g} mm above it, or its geom does not collide with a plane"
                " (contype, conaffinity)",
            )


def _run(
    model: mujoco.MjModel, controls: Float[np.ndarray, "t nu"]
) -> Float[np.ndarray, "t 3"] | None:
    """Return (x, y, yaw rate) of the robot at every step; None if it is not finite."""
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data, path = mujoco.MjData(model), np.zeros((len(controls), 3))
    data.warning.number[:] = 1  # MuJoCo would print the first of a kind
    for i, control in enumerate(controls):
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        if not np.abs(data.qvel).max() < mujoco.mjMAXVAL:
            return None
        path[i] = *data.qpos[QPOS_XYZ][:2], data.qvel[QVEL_ANGULAR_B][2]
    return path
