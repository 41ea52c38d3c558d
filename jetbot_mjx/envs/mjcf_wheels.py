"""Find the wheels of a robot that is a MuJoCo model of a user's own.

Every message names what is wrong in the user's file and what would be right.
"""

import difflib
import types
from collections.abc import Collection, Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.config import MjcfRobotConfig, Sides, TaskConfig, model_files
from jetbot_mjx.envs.drive import (
    AckermannDrive,
    DifferentialDrive,
    Drive,
    OwnDrive,
    Wheel,
    largest_curvature,
)
from jetbot_mjx.envs.mjcf_robot import PREFIX, RobotFileError, parse_model

_LARGEST_RADIUS = 0.5  # [m]
_PARALLEL = 0.95  # smallest cosine between directions that should be parallel
_SIDES = ("left", "right", "middle")
_NEAR = 1e-3  # [m] largest distance of what is in the middle, or on one axle
_ROLLING = {mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID}
_LONG = {mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE}


def _side(y: float) -> str:
    """Return the side of a robot on which a wheel is, by its position to the left [m]."""
    return "middle" if abs(y) <= _NEAR else "left" if y > 0 else "right"


def find_drive(robot: MjcfRobotConfig, task: TaskConfig, model: mujoco.MjModel) -> Drive:
    """Find the wheels of a robot, and what an action means for each.

    Args:
      robot: the section `robot`.
      task: the section `task`, with the limits of speed and yaw rate.
      model: the compiled scene, with the robot.

    Raises:
      RobotFileError: an actuator or a wheel is not as it should be.
    """
    if robot.wheels is None:
        return _own_drive(robot, model)
    parts = _Parts(robot, model)
    wheels = parts.wheels(robot.wheels, "wheels")
    steered = () if robot.steering is None else parts.wheels(robot.steering, "steering")
    parts.check_actuators((*wheels, *steered))
    radius = float(np.mean([one.radius for one in wheels]))
    if not steered:
        apart = float(np.mean([2.0 * abs(one.y) for one in wheels]))
        return DifferentialDrive(
            task.max_speed,
            task.max_yaw_rate,
            radius,
            robot.wheel_separation or apart,
            tuple(sorted(wheels)),
        )
    rear = parts.rear(wheels, steered)
    angles = parts.limits(steered)
    curvature = largest_curvature(steered, rear, angles)
    return AckermannDrive(task.max_speed, curvature, radius, rear, wheels, steered)


def _own_drive(robot: MjcfRobotConfig, model: mujoco.MjModel) -> OwnDrive:
    """Return the drive that is a function in a file beside the model."""
    file, _, name = robot.drive.partition(":")
    module = types.ModuleType(file.removesuffix(".py"))
    try:
        exec(compile((model_files(robot.sha256) or {})[file], file, "exec"), module.__dict__)
        drive = OwnDrive(getattr(module, name), robot.action_size)
        action = jax.ShapeDtypeStruct((robot.action_size,), jnp.float32)
        shape = jax.eval_shape(drive.controls, action).shape
    except jax.errors.JAXTypeError as error:
        raise RobotFileError(
            robot,
            f"robot.drive = {robot.drive!r} is not written in JAX ({type(error).__name__}): take"
            " jax.numpy in place of NumPy, and jnp.where in place of `if`",
        ) from None
    # It is the user's code: whatever it raises belongs into the one line.
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {error}"
        raise RobotFileError(robot, f"robot.drive = {robot.drive!r}: {reason}") from None
    if shape != (model.nu,):
        raise RobotFileError(
            robot,
            f"robot.drive = {robot.drive!r} returns the shape {list(shape)}: the model has"
            f" {model.nu} actuators",
        )
    return drive


class _Joints:
    """The joints of a robot in its initial pose, in the frame of its base."""

    def __init__(self, model: mujoco.MjModel) -> None:
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)
        self._base = model.jnt_bodyid[free[0]] if free.size else 0
        self.rotation = self.data.xmat[self._base].reshape(3, 3)

    def of(self, actuator: int) -> int:
        """Return the joint of an actuator."""
        return self.model.actuator_trnid[actuator, 0]

    def axis(self, joint: int) -> Float[np.ndarray, "3"]:
        """Return the axis of a joint."""
        return self.rotation.T @ self.data.xaxis[joint]

    def place(self, joint: int) -> Float[np.ndarray, "3"]:
        """Return the place of a joint [m]."""
        return self.rotation.T @ (self.data.xanchor[joint] - self.data.xpos[self._base])


class _Parts:
    """The parts of a robot that its configuration names."""

    def __init__(self, robot: MjcfRobotConfig, model: mujoco.MjModel) -> None:
        self._robot, self._model, self._joints = robot, model, _Joints(model)

    def _error(self, key: str, reason: str) -> RobotFileError:
        return RobotFileError(self._robot, f"robot.{key}: {reason}")

    def wheels(self, sides: Sides, key: str) -> tuple[Wheel, ...]:
        """Return the wheels of all sides."""
        named = [(name, side) for side in _SIDES for name in getattr(sides, side)]
        found = tuple(self._wheel(name, f"{key}.{side}") for name, side in named)
        names = [name for name, _ in named]
        if twice := {name for name in names if names.count(name) > 1}:
            raise self._error(key, f"{', '.join(sorted(twice))} is named twice")
        for (name, side), wheel in zip(named, found, strict=True):
            if (there := _side(wheel.y)) != side:
                apart = f"{abs(wheel.y):.3g} m to the {there}"
                raise self._error(
                    f"{key}.{side}",
                    f"{name} is {'in the middle' if there == 'middle' else apart} of the base: name"
                    f" it under {there}, or turn the base so that x is forward",
                )
        radii = [one.radius for one in found]
        if max(radii) - min(radii) > 0.01 * max(radii):
            raise self._error(key, f"wheels of {min(radii):g} and {max(radii):g} m: give them one")
        return found

    def check_actuators(self, wheels: Sequence[Wheel]) -> None:
        """Check that every actuator is of one wheel."""
        named, model = {one.actuator for one in wheels}, self._model
        if left := [model.actuator(i).name for i in range(model.nu) if i not in named]:
            names = ", ".join(name.removeprefix(PREFIX) or "one without a name" for name in left)
            raise RobotFileError(
                self._robot,
                f"no wheel has the actuator {names}: name it in robot.wheels or robot.steering, or"
                " leave it out of the model",
            )

    def limits(self, steered: Sequence[Wheel]) -> Float[np.ndarray, " n"]:
        """Return the largest angle of each steered wheel [rad]."""
        limits, model = [], self._model
        for one in steered:
            name = model.actuator(one.actuator).name.removeprefix(PREFIX)
            if not model.actuator_ctrllimited[one.actuator]:
                raise self._error("steering", f"{name} has no limits: give it a ctrlrange [rad]")
            limits.append(np.abs(model.actuator_ctrlrange[one.actuator] / one.gain).min())
        joints = [self._joints.of(one.actuator) for one in steered]
        stops = np.abs(model.jnt_range[joints]).min(axis=1)
        angles = np.minimum(limits, np.where(model.jnt_limited[joints], stops, np.inf))
        if min(angles) < 0.02 or max(limits) > 1.4:
            raise self._error(
                "steering",
                f"angles of {min(angles):.3g} to {max(limits):.3g} rad: 0.02 to 1.4 are"
                " right; a ctrlrange is in radians, and a joint's range in degrees unless there is"
                ' <compiler angle="radian"/>',
            )
        return angles

    def rear(self, driven: Sequence[Wheel], steered: Sequence[Wheel]) -> float:
        """Return how far ahead of the base the wheels are that do not turn to the side [m].

        Those are the driven ones, else, of a car with front-wheel drive, those without an actuator.
        Of a car that steers all wheels, the rear ones then stay straight.
        """
        model = self._model
        turning = {model.jnt_bodyid[self._joints.of(one.actuator)] for one in steered}
        hinges = [
            joint
            for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE).tolist()
            if abs(self._joints.axis(joint)[1]) > _PARALLEL and not self._is_on(joint, turning)
        ]
        of_motors = [one for one in hinges if one in {self._joints.of(x.actuator) for x in driven}]
        still = [self._joints.place(joint)[0] for joint in of_motors or hinges]
        rear = float(np.mean(still or [min(one.x for one in steered)]))
        if max(abs(one.x - rear) for one in steered) < _NEAR:
            raise self._error(
                "steering",
                "no wheel that stays straight is behind the steered ones or before them: a car"
                " turns about the axle of such wheels, whose hinges are parallel to y",
            )
        return rear

    def _is_on(self, joint: int, bodies: Collection[int]) -> bool:
        """Return whether a joint's body is one of some bodies, or on one."""
        body = self._model.jnt_bodyid[joint]
        while body and body not in bodies:
            body = self._model.body_parentid[body]
        return body in bodies

    def _joint_name(self, joint: int) -> str:
        return self._model.joint(joint).name.removeprefix(PREFIX) or f"joint {joint}"

    def _wheel(self, name: str, key: str) -> Wheel:
        """Return a wheel by the name of its actuator."""
        model = self._model
        names = [model.actuator(i).name.removeprefix(PREFIX) for i in range(model.nu)]
        if name not in names:
            close = difflib.get_close_matches(name, names, 1)
            told = ", ".join(one or "one without a name" for one in names) or "none"
            hint = f"did you mean {close[0]}?" if close else f"there are {told}"
            raise self._error(key, f"the model has no actuator {name!r}: {hint}")
        index = names.index(name)
        if model.actuator_trntype[index] != mujoco.mjtTrn.mjTRN_JOINT:
            raise self._error(key, f"{name} drives no joint: give it joint=…")
        if model.actuator_dyntype[index] != mujoco.mjtDyn.mjDYN_NONE:
            raise self._error(key, f"{name} has a state of its own (dyntype): leave it out")
        joint = self._joints.of(index)
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            raise self._error(key, f"{name} drives {self._joint_name(joint)}, which is no hinge")
        steers = key.startswith("steering")
        self._check_servo(index, name, key, steers=steers)
        if model.jnt_limited[joint] and not steers:
            reason = "has a range: a wheel turns without an end"
            raise self._error(key, f"{name} drives {self._joint_name(joint)}, which {reason}")
        axis, place = self._joints.axis(joint), self._joints.place(joint)
        along = axis[2 if steers else 1]
        if abs(along) < _PARALLEL:
            wanted = "up (0 0 1)" if steers else "to the left (0 1 0)"
            raise self._error(
                key,
                f"the axis of {self._joint_name(joint)} is {_numbers(axis)} in the frame of the"
                f" base: it should point {wanted}, where x is forward",
            )
        gear = model.actuator_gear[index, 0]
        radius = 0.0 if steers else self._radius(int(model.jnt_bodyid[joint]), axis, name, key)
        return Wheel(index, float(place[0]), float(place[1]), float(np.sign(along) * gear), radius)

    def _check_servo(self, index: int, name: str, key: str, *, steers: bool) -> None:
        """Check that an actuator takes a speed or an angle as its control."""
        gain, bias = self._model.actuator_gainprm[index, 0], self._model.actuator_biasprm[index]
        follows = bias[1] if steers else bias[2]
        if self._model.actuator_gear[index, 0] == 0.0:
            raise self._error(key, f"{name} has a gear of 0, which moves nothing: leave it out")
        if gain <= 0 or not np.isclose(follows, -gain) or (not steers and bias[1] != 0):
            kind = "<position kp=… ctrlrange=…>" if steers else "<velocity kv=… forcerange=…>"
            what = "an angle" if steers else "a wheel speed"
            raise self._error(key, f"{name} does not take {what} as its control: make it {kind}")

    def _radius(self, body: int, axis: Float[np.ndarray, "3"], name: str, key: str) -> float:
        """Return the radius of a wheel [m]."""
        if self._robot.wheel_radius is not None:
            return self._robot.wheel_radius
        model = self._model
        paired = {*model.pair_geom1, *model.pair_geom2}
        radii = []
        for geom in np.flatnonzero(model.geom_bodyid == body):
            if not (model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in paired):
                continue
            kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
            own = self._joints.rotation.T @ self._joints.data.geom_xmat[geom].reshape(3, 3)
            if kind in _ROLLING:
                radii.append(size[0] if kind == mujoco.mjtGeom.mjGEOM_SPHERE else max(size))
            elif kind in _LONG and abs(own[:, 2] @ axis) > _PARALLEL:
                radii.append(size[0])
        if not radii:
            raise self._error(
                key,
                f"{name} has no sphere, ellipsoid, cylinder or capsule around its axis that touches"
                " the floor: add one, or set robot.wheel_radius",
            )
        if max(radii) > _LARGEST_RADIUS:
            raise self._error(
                key,
                f"the wheel of {name} has a radius of {max(radii):g} m: lengths are in metres"
                " (millimetres are metres × 0.001)",
            )
        return float(max(radii))


def _numbers(vector: Float[np.ndarray, "3"]) -> str:
    return f"({' '.join(f'{x:.2g}' for x in np.round(vector, 3) + 0.0)})"


def guess_section(file: str, files: Mapping[str, bytes]) -> dict[str, object]:
    """Return a section `robot` for a model: its actuators by what they turn, and by their side.

    Args:
      file: name of the model.
      files: its content, and that of the files that it names.

    Returns:
      The section; empty where no actuator turns a wheel, or the model cannot be compiled.
    """
    try:
        model = parse_model(file, files).compile()
    except (ValueError, mujoco.FatalError):
        return {}
    joints = _Joints(model)
    parts: dict[str, dict[str, list[str]]] = {"wheels": {}, "steering": {}}
    for index in range(model.nu):
        if model.actuator_trntype[index] != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        joint = joints.of(index)
        kind = "steering" if abs(joints.axis(joint)[2]) > _PARALLEL else "wheels"
        side = _side(joints.place(joint)[1])
        parts[kind].setdefault(side, []).append(model.actuator(index).name)
    wheels, steering = parts["wheels"], parts["steering"]
    if wheels and steering:
        return {"file": file, "wheels": wheels, "drive": "ackermann", "steering": steering}
    return {"file": file, "wheels": wheels} if set(wheels) == {"left", "right"} else {}
