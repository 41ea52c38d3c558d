"""Make the MuJoCo model of the robot and its scene.

The JetBot is made from its measures; another robot is a model of its own, as of `mjcf_robot`. All
positions are in the body frame: the origin is the midpoint of the wheel axle, x is forward, y
is left, z is up. Units are SI units.
"""

from collections.abc import Callable
from importlib import resources

import mujoco
import numpy as np

from jetbot_mjx.config import MjcfRobotConfig, PhysicsConfig, RobotConfig, TaskConfig
from jetbot_mjx.envs import mjcf_robot
from jetbot_mjx.envs.mjcf_wheels import find_drive
from jetbot_mjx.errors import UserError

_LARGEST_LEAN = np.radians(15.0)  # SIM: further over, the camera and the chassis are elsewhere

_REST = 2.0  # [s] in which a robot comes to rest; one that is top-heavy sways for longer
_MOST_RESTS = 5

_DRAWN_CHASSIS = np.array([0.136, 0.090, 0.054])  # [m] that of `assets/jetbot.xml`
_DRAWN_WHEEL = np.array([0.0325, 0.0195])  # [m] its radius and its width

QPOS_XYZ, QPOS_QUAT = slice(0, 3), slice(3, 7)
QVEL_LINEAR_W, QVEL_ANGULAR_B = slice(0, 3), slice(3, 6)

# Contact parameters of every pair, softer than MuJoCo's defaults. In a pyramidal cone the friction
# of a sliding wheel also pushes it off the floor, more so in a stiffer contact: with μ = 0.4,
# (0.02, 1) and (0.95, 0.99) the robot hops and tilts by 5°, even with a converged solver.
_SOLREF = (0.04, 1.0)  # time constant [s], damping ratio; SIM
_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)  # SIM


def make_mj_model(
    robot: RobotConfig | MjcfRobotConfig,
    physics: PhysicsConfig,
    *,
    build_scene: Callable[[mujoco.MjSpec], None] = lambda spec: None,
    visual: bool = True,
) -> mujoco.MjModel:
    """Compile the robot and its scene.

    Args:
      robot: the section `robot` of the configuration.
      physics: the physics section of the configuration: time step and solver settings.
      build_scene: a function that adds a task's bodies to the scene.
      visual: whether to include visual elements. They do not change physics, but cost kernels.

    Returns:
      The C model. Its `qpos` begins with (x, y, z, w, x, y, z) of the robot's body, and of a JetBot
      ends with the wheels (left, right). In its initial pose, `qpos0`, the robot is at rest on the
      floor.

    Raises:
      UserError: the physics time step is too long for the robot's motors, it leans at rest, or
        its own model cannot be used.
      RuntimeError: the robot does not come to rest in this scene.
      ValueError: MuJoCo rejects the scene.
    """
    text = resources.files("jetbot_mjx").joinpath("assets/jetbot.xml").read_text()
    spec = mujoco.MjSpec.from_string(text)
    _set_options(spec, physics)
    if isinstance(robot, MjcfRobotConfig):
        _remove_jetbot(spec)
        mjcf_robot.add_robot(spec, robot)
        # What is wrong with a wheel would otherwise be told as a robot that does not rest.
        find_drive(robot, TaskConfig(), spec.compile())
    else:
        _check_stable(robot, physics)
        _scale_looks(spec, robot)
        _set_robot(spec, robot)
    build_scene(spec)
    if not visual:
        _remove_visuals(spec)
    _settle(spec)
    return spec.compile()


def robot_body(model: mujoco.MjModel) -> str:
    """Return the name of the robot's body, which the first joint moves."""
    return model.body(int(model.jnt_bodyid[0])).name


def _remove_jetbot(spec: mujoco.MjSpec) -> None:
    """Leave the scene alone, without the JetBot and what MuJoCo's default would not do."""
    for actuator in spec.actuators:
        spec.delete(actuator)
    spec.delete(spec.body("jetbot"))
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)


def mocap_ids(model: mujoco.MjModel) -> dict[str, int]:
    """Return the indices of a model's mocap bodies, which a task places, by name, in order."""
    bodies = np.argsort(model.body_mocapid)[model.nbody - model.nmocap :].tolist()
    return {model.body(body).name: index for index, body in enumerate(bodies)}


def _check_stable(robot: RobotConfig, physics: PhysicsConfig) -> None:
    """Check the stability of explicit Euler: timestep * motor_gain / wheel inertia < 2."""
    limit = 2.0 * (robot.moments_of_wheel[1] + robot.armature) / robot.motor_gain
    if physics.sim_dt >= limit:
        raise UserError(
            f"physics.sim_dt = {physics.sim_dt:g} is too long: this robot's motors are stable"
            f" below {limit:.2g} s: make it shorter, robot.motor_gain smaller, or robot.armature"
            " larger"
        )


def _set_options(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    option = spec.option
    option.timestep = physics.ctrl_dt / physics.n_substeps
    # Explicit Euler is the cheapest, and stable as long as `_check_stable` holds.
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.iterations = physics.iterations
    option.ls_iterations = physics.ls_iterations
    option.tolerance = physics.tolerance


def _scale_looks(spec: mujoco.MjSpec, robot: RobotConfig) -> None:
    """Scale what only shows to the size of chassis and wheels."""
    scale = robot.chassis_size / _DRAWN_CHASSIS
    for geom in spec.body("jetbot").geoms:
        geom.pos = geom.pos * scale
        geom.fromto = geom.fromto * np.tile(scale, 2)
        if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
            geom.size = geom.size * scale
    radius, width = np.array([robot.wheel_radius, robot.wheel_width]) / _DRAWN_WHEEL
    for side in ("left", "right"):
        for geom in spec.body(f"{side}_wheel").geoms:
            is_box = geom.type == mujoco.mjtGeom.mjGEOM_BOX
            geom.size = geom.size * ((radius, width, radius) if is_box else (radius, width, 1.0))


def _set_robot(spec: mujoco.MjSpec, robot: RobotConfig) -> None:
    """Set masses, geometry, motors and contacts of the robot."""
    # Chassis and wheels.
    chassis = spec.body("jetbot")
    chassis.mass = robot.chassis_mass
    chassis.ipos = robot.chassis_com
    chassis.inertia = robot.moments_of_chassis
    for side, sign in (("left", 1.0), ("right", -1.0)):
        wheel = spec.body(f"{side}_wheel")
        wheel.pos = (0.0, sign * robot.wheel_separation / 2, 0.0)
        wheel.mass = robot.wheel_mass
        wheel.inertia = robot.moments_of_wheel
        # A sphere touches a plane in the same single point as a wheel; a cylinder has several
        # contacts, which jitter.
        spec.geom(f"{side}_wheel").size = (robot.wheel_radius, 0.0, 0.0)
        spec.joint(f"{side}_wheel_joint").armature = robot.armature
        motor = spec.actuator(side)
        motor.set_to_velocity(kv=robot.motor_gain)
        motor.forcerange = (-robot.motor_torque, robot.motor_torque)
        motor.forcelimited = True
        if robot.max_wheel_speed is not None:
            motor.ctrlrange = (-robot.max_wheel_speed, robot.max_wheel_speed)
            motor.ctrllimited = True
        slide = robot.friction
        _add_pair(spec, f"{side}_wheel", condim=3, friction=(slide, slide, 5e-3, 1e-4, 1e-4))
    # Casters: those that collide, then those that show.
    balls = {f"caster_{i}": caster for i, caster in enumerate(robot.casters)}
    for suffix, looks in (("", spec.find_default("collider")), ("_ball", None)):
        for name, caster in balls.items():
            height = -robot.wheel_radius + caster.clearance + caster.radius
            ball = chassis.add_geom(looks, name=name + suffix, type=mujoco.mjtGeom.mjGEOM_SPHERE)
            ball.pos, ball.size = (caster.x, caster.y, height), (caster.radius, 0.0, 0.0)
            if looks is None:
                ball.material = "metal"
    for name in balls:
        _add_pair(spec, name, condim=1)


def _add_pair(
    spec: mujoco.MjSpec,
    geom: str,
    *,
    condim: int,
    friction: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0),
) -> None:
    """Add a contact pair of a geom with the floor.

    Pairs are explicit, because MuJoCo otherwise takes the larger friction of the two geoms: a
    frictionless caster would inherit the floor's.
    """
    spec.add_pair(
        name=geom,
        geomname1="floor",
        geomname2=geom,
        condim=condim,
        friction=friction,
        solref=_SOLREF,
        solimp=_SOLIMP,
    )


def _remove_visuals(spec: mujoco.MjSpec) -> None:
    """Remove all elements that do not take part in physics."""
    paired = {pair.geomname1 for pair in spec.pairs} | {pair.geomname2 for pair in spec.pairs}
    for geom in spec.geoms:
        collides = geom.name in paired or geom.contype or geom.conaffinity
        # The mass of a body that does not state its own is that of its geoms.
        if not collides and (geom.mass == 0 or geom.parent.explicitinertial):
            spec.delete(geom)
    holds = spec.tendons or spec.equalities
    for element in (*spec.cameras, *spec.lights, *(() if holds else spec.sites)):
        spec.delete(element)
    for body in spec.bodies:
        if body.mocap and not body.geoms:
            spec.delete(body)


def _lifted_wheel(model: mujoco.MjModel, data: mujoco.MjData) -> str | None:
    """Return the name of the first body with a motor that touches nothing; None: all touch."""
    touching = set(model.geom_bodyid[data.contact.geom].ravel().tolist())
    driven = model.jnt_bodyid[model.actuator_trnid[:, 0]].tolist()
    names = (
        model.body(body).name.removeprefix(mjcf_robot.PREFIX)
        for body in driven
        if body not in touching
    )
    return next(names, None)


def _settle(spec: mujoco.MjSpec) -> None:
    """Set the initial pose to the robot at rest, so that no episode starts with a drop."""
    model = spec.compile()
    # Use a converged solver, and the implicit integrator, with which motion decays faster.
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    data = mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data.warning.number[:] = 1  # they are told below, and MuJoCo would print the first of a kind
    for _ in range(_MOST_RESTS):
        mujoco.mj_step(model, data, nstep=int(_REST / model.opt.timestep))
        fastest = np.max(np.abs(data.qvel))
        if fastest <= 1e-3:
            break
    else:
        below = data.body(robot_body(model)).xpos[2] < 0.0
        reason = (
            "it falls through the floor: no wheel collides with that (contype, conaffinity)"
            if below
            else "it falls over, or something pushes it"
        )
        raise RuntimeError(
            f"the robot does not come to rest: after {_MOST_RESTS * _REST:g} s it moves with up to"
            f" {fastest:.3g} m/s or rad/s: {reason}"
        )
    # Keep only height and pitch: the robot may have crept along the floor.
    body = spec.body(robot_body(model))
    body.pos = (0.0, 0.0, data.qpos[2])
    pitch = 2.0 * np.arcsin(data.qpos[5])
    if abs(pitch) > _LARGEST_LEAN:
        lifted = _lifted_wheel(model, data)
        remedy = (
            "support it there, as by a caster closer to the floor"
            if lifted is None
            else f"its wheel {lifted!r} does not touch the floor: make it larger, or lower it"
        )
        raise UserError(
            f"at rest the robot leans {np.degrees(abs(pitch)):.0f}° to the"
            f" {'front' if pitch > 0 else 'rear'}: {remedy}"
        )
    body.quat = (np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0)
