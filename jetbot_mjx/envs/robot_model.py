"""Define the robot: the numbers of two presets, and the MuJoCo model made from them.

Every number has its unit and its source. All positions are in the body frame: the origin is the
midpoint of the wheel axle, x is forward, y is left, z is up. Units are SI units.

Sources, by tag:
  CAD    NVIDIA-AI-IOT/jetbot, assets/*.stl and *.step, measured.
  BOM    NVIDIA-AI-IOT/jetbot, docs/bill_of_materials.md.
  USD    a public copy of Isaac's jetbot.usd (snt-spacer/RobRAN-Code), read with usd-core.
  ISAAC  Isaac Sim 2022.x documentation, section 9.9, and its `DifferentialController`.
  EST    an estimate; the comment names its basis.
  SIM    chosen in simulation and checked by `tests/envs/test_robot_model.py`.
"""

import dataclasses
from collections.abc import Callable
from importlib import resources

import mujoco
import numpy as np

from jetbot_mjx.config import PhysicsConfig
from jetbot_mjx.errors import UserError

# The tutorial's controller assumes a geometry of its own: the mismatch of 1.3 % between its wheel
# base and the true wheel separation is part of the task.
CONTROLLER_WHEEL_RADIUS = 0.0325  # [m] ISAAC, DifferentialController(wheel_radius=0.0325)
CONTROLLER_WHEEL_SEPARATION = 0.1125  # [m] ISAAC, wheel_base=0.1125: left to right

WHEEL_RADIUS = 0.0325  # [m] BOM: 65 mm wheel; CAD: its caster puts the axle 32.5 mm up
WHEEL_SEPARATION = 0.114  # [m] USD: wheel meshes centred at y = ±0.0570

QPOS_XYZ, QPOS_QUAT = slice(0, 3), slice(3, 7)
QVEL_LINEAR_W, QVEL_ANGULAR_B = slice(0, 3), slice(3, 6)


@dataclasses.dataclass(frozen=True)
class Caster:
    """A `Caster` describes a frictionless ball under the chassis."""

    name: str
    """Name of its collision geom."""
    radius: float
    """Radius of the ball [m]."""
    pos: tuple[float, float, float]
    """Centre of the ball [m]."""


@dataclasses.dataclass(frozen=True)
class Robot:
    """A `Robot` holds the physical parameters of a JetBot."""

    chassis_mass: float
    """Mass without the wheels [kg]."""
    chassis_com: tuple[float, float, float]
    """Centre of mass of the chassis [m]."""
    chassis_inertia: tuple[float, float, float]
    """Principal moments of the chassis about its centre of mass [kg m²]."""
    wheel_mass: float
    """Mass of one wheel [kg]."""
    wheel_inertia: tuple[float, float, float]
    """Moments of inertia of a wheel about x, y (the axle) and z [kg m²]."""
    casters: tuple[Caster, ...]
    """Casters of the chassis."""
    motor_torque: float
    """Largest torque of a motor at the wheel [N m]."""
    motor_gain: float
    """Gain of the speed controller: torque per error of the wheel speed [N m s/rad]."""
    armature: float
    """Rotor inertia, reflected through the gear to the wheel [kg m²]."""
    max_wheel_speed: float | None
    """Limit of the commanded wheel speed [rad/s]; None: not limited."""
    friction: float = 1.0
    """Coulomb friction coefficient between wheel and floor. USD: 1.0, combined by maximum."""


def _box_inertia(mass: float, size: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the principal moments of a homogeneous box [kg m²] from mass [kg] and sides [m]."""
    x, y, z = (side * side for side in size)
    return mass / 12 * (y + z), mass / 12 * (x + z), mass / 12 * (x + y)


def _wheel_inertia(mass: float, width: float) -> tuple[float, float, float]:
    """Return the moments of a homogeneous wheel [kg m²] from mass [kg] and width [m]."""
    spin = mass * WHEEL_RADIUS**2 / 2
    across = mass * (3 * WHEEL_RADIUS**2 + width**2) / 12
    return across, spin, across


_CHASSIS_SIZE = (0.136, 0.090, 0.054)  # [m] CAD, envelope of the printed chassis

ISAAC = Robot(
    chassis_mass=2.0,  # USD
    # EST: the USD has none. Midway between the casters at the height of the axle, which keeps
    # Isaac's robot on its wheels at 1 m/s.
    chassis_com=(-0.022, 0.0, 0.0),
    chassis_inertia=_box_inertia(2.0, _CHASSIS_SIZE),  # EST: homogeneous box
    wheel_mass=0.25,  # USD
    wheel_inertia=_wheel_inertia(0.25, width=0.0195),  # USD: width of the wheel mesh
    casters=(
        # USD: radius 4.76 mm, bottoms 0.5 mm above the wheels' contact plane.
        Caster("caster_front", 0.00476, (0.038, 0.0, -WHEEL_RADIUS + 0.0005 + 0.00476)),
        Caster("caster_rear", 0.00476, (-0.082, 0.0, -WHEEL_RADIUS + 0.0005 + 0.00476)),
    ),
    motor_torque=0.1,  # SIM: keeps the worst tilt under 1.5°
    motor_gain=0.05,  # SIM: Isaac's 1e4 is unstable at any useful time step
    armature=3e-4,  # EST: rotor 1.4e-7 kg m² through the 1:48 gear
    max_wheel_speed=None,  # the tutorial's 1 m/s needs 31 rad/s; USD would stop at 12.56
)

REAL = Robot(
    chassis_mass=0.634,  # EST: sum of the BOM's parts, 0.69 kg in total (0.60 to 0.85)
    chassis_com=(-0.0346, 0.0, 0.0257),  # EST: the BOM's parts at their CAD places
    chassis_inertia=(6.2e-4, 1.08e-3, 1.14e-3),  # EST: likewise
    wheel_mass=0.030,  # EST: a TT-motor wheel of 65 mm
    wheel_inertia=(8.9e-6, 1.6e-5, 8.9e-6),  # EST: likewise
    casters=(
        # CAD: one 1-inch ball, 82 mm behind the axle, touching the floor.
        Caster("caster_rear", 0.0127, (-0.082, 0.0, -WHEEL_RADIUS + 0.0127)),
    ),
    motor_torque=0.064,  # a TT motor's stall torque (0.8 kg cm at 6 V), scaled to 5 V
    motor_gain=0.05,  # SIM, as above
    armature=3e-4,  # EST, as above
    max_wheel_speed=12.56,  # [rad/s] USD, maxJointVelocity 719.635 °/s: 0.41 m/s
)

ROBOTS = {"isaac": ISAAC, "real": REAL}

# Contact parameters of every pair, softer than MuJoCo's defaults. In a pyramidal cone the friction
# of a sliding wheel also pushes it off the floor, more so in a stiffer contact: with μ = 0.4,
# (0.02, 1) and (0.95, 0.99) the robot hops and tilts by 5°, even with a converged solver.
_SOLREF = (0.04, 1.0)  # time constant [s], damping ratio; SIM
_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)  # SIM


def make_mj_model(
    robot: Robot,
    physics: PhysicsConfig,
    *,
    build_scene: Callable[[mujoco.MjSpec], None] = lambda spec: None,
    visual: bool = True,
) -> mujoco.MjModel:
    """Compile the robot and its scene.

    Args:
      robot: the physical parameters.
      physics: the physics section of the configuration: time step and solver settings.
      build_scene: a function that adds a task's bodies to the scene.
      visual: whether to include visual elements. They do not change physics, but cost kernels.

    Returns:
      The C model. Its `qpos` is (x, y, z, w, x, y, z, left, right), and in its initial pose,
      `qpos0`, the robot is at rest on the floor.

    Raises:
      UserError: the physics time step is too long for the robot's motors.
      RuntimeError: the robot does not come to rest in this scene.
      ValueError: MuJoCo rejects the scene.
    """
    text = resources.files("jetbot_mjx").joinpath("assets/jetbot.xml").read_text()
    spec = mujoco.MjSpec.from_string(text)
    _check_stable(robot, physics)
    _set_options(spec, physics)
    _set_robot(spec, robot)
    build_scene(spec)
    if not visual:
        _remove_visuals(spec)
    _settle(spec)
    return spec.compile()


def mocap_ids(model: mujoco.MjModel) -> dict[str, int]:
    """Return the indices of a model's mocap bodies, which a task places, by name, in order."""
    bodies = np.argsort(model.body_mocapid)[model.nbody - model.nmocap :].tolist()
    return {model.body(body).name: index for index, body in enumerate(bodies)}


def _check_stable(robot: Robot, physics: PhysicsConfig) -> None:
    """Check the stability of explicit Euler: timestep * motor_gain / wheel inertia < 2."""
    limit = 2.0 * (robot.wheel_inertia[1] + robot.armature) / robot.motor_gain
    if physics.sim_dt >= limit:
        raise UserError(
            f"physics.sim_dt = {physics.sim_dt:g} is too long: this robot's motors are stable"
            f" below {limit:.4f} s"
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


def _set_robot(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Set masses, geometry, motors and contacts of the robot."""
    # Chassis and wheels.
    chassis = spec.body("jetbot")
    chassis.mass = robot.chassis_mass
    chassis.ipos = robot.chassis_com
    chassis.inertia = robot.chassis_inertia
    for side, sign in (("left", 1.0), ("right", -1.0)):
        wheel = spec.body(f"{side}_wheel")
        wheel.pos = (0.0, sign * WHEEL_SEPARATION / 2, 0.0)
        wheel.mass = robot.wheel_mass
        wheel.inertia = robot.wheel_inertia
        # A sphere touches a plane in the same single point as a wheel; a cylinder has several
        # contacts, which jitter.
        spec.geom(f"{side}_wheel").size = (WHEEL_RADIUS, 0.0, 0.0)
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
    # Casters.
    casters = {caster.name: caster for caster in robot.casters}
    for name in ("caster_front", "caster_rear"):
        if name not in casters:
            spec.delete(spec.geom(name))
            spec.delete(spec.geom(f"{name}_ball"))
            continue
        for geom in (spec.geom(name), spec.geom(f"{name}_ball")):
            geom.pos = casters[name].pos
            geom.size = (casters[name].radius, 0.0, 0.0)
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
        if geom.name not in paired and not geom.contype and not geom.conaffinity:
            spec.delete(geom)
    for element in (*spec.cameras, *spec.lights, *spec.sites):
        spec.delete(element)
    for body in spec.bodies:
        if body.mocap and not body.geoms:
            spec.delete(body)


def _settle(spec: mujoco.MjSpec) -> None:
    """Set the initial pose to the robot at rest, so that no episode starts with a drop."""
    model = spec.compile()
    # Use a converged solver, and the implicit integrator, with which motion decays faster.
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=int(2.0 / model.opt.timestep))
    if not np.all(np.isfinite(data.qpos)) or np.max(np.abs(data.qvel)) > 1e-3:
        raise RuntimeError(f"the robot does not come to rest: qvel = {data.qvel}")
    # Keep only height and pitch: the robot may have crept along the floor.
    body = spec.body("jetbot")
    body.pos = (0.0, 0.0, data.qpos[2])
    pitch = 2.0 * np.arcsin(data.qpos[5])
    body.quat = (np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0)
