"""Make the scene of a robot that is a MuJoCo model of a user's own.

Every message names what is wrong in the user's file and what would be right.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.config import MjcfRobotConfig, model_files
from jetbot_mjx.errors import UserError

PREFIX = "robot/"
"""What the names of a robot's parts begin with in the scene."""

_DRAWN_EXTENT = 0.12  # [m] of a JetBot, for which the views are made
_VIEWS = {"chase": ((-0.55, 0.0, 0.40), 30.0, 58.0), "onboard": ((0.031, 0.0, 0.0538), 20.0, 115.0)}
"""Cameras for videos: place [m], angle by which they look down [°], vertical field of view [°]."""

_OPTIONS_OF_MODEL = ("integrator", "gravity", "density", "viscosity", "wind", "impratio")
"""Options of MuJoCo that a robot's model decides, beside the flags that disable a part of it."""

_ONLY_IN_C = {
    "actuator_delay": "the delay of an actuator (randomization.action_delay does)",
    "actuator_damping": "the damping of an actuator (that of a joint it does)",
    "actuator_dampingpoly": "the damping of an actuator (that of a joint it does)",
    "actuator_armature": "the armature of an actuator (that of a joint it does)",
    "dof_dampingpoly": "damping of a joint with more numbers than one",
    "jnt_stiffnesspoly": "stiffness of a joint with more numbers than one",
    "tendon_dampingpoly": "damping of a tendon with more numbers than one",
    "tendon_stiffnesspoly": "stiffness of a tendon with more numbers than one",
    "tendon_armature": "the armature of a tendon as MuJoCo does",
    "geom_adhesion": "adhesion of a geom",
    "pair_adhesion": "adhesion of a contact",
    "geom_surfacevel": "the velocity of a geom's surface",
}
"""Arrays of a model that MJX takes for zero, by name, with what they are in a message."""

_SOLREFS = (
    *("geom_solref", "pair_solref", "jnt_solref", "dof_solref", "eq_solref"),
    *("tendon_solref_lim", "tendon_solref_fri"),
)
"""Arrays of a model whose two numbers are both above 0, or both not."""

_PARTS = {"body": "body", "jnt": "joint", "geom": "geom"}

_LARGEST_MASS = 1000.0  # [kg] of a small robot
_LARGEST_LENGTH = 10_000.0  # [m]

_SIZES = ("memory", "njmax", "nconmax", "nstack")
"""Sizes of MuJoCo's memory, of which the scene has its own."""


class RobotFileError(UserError):
    """A robot's model cannot be used."""

    def __init__(self, robot: MjcfRobotConfig, reason: str) -> None:
        """Name the file in the message."""
        super().__init__(f"robot.file = {robot.file!r}: {' '.join(reason.split())}")


def load_spec(robot: MjcfRobotConfig) -> mujoco.MjSpec:
    """Read a robot's model.

    Args:
      robot: the section `robot`.

    Raises:
      RobotFileError: the model is not known to this process, or MuJoCo refuses it.
    """
    files = model_files(robot.sha256)
    if files is None:
        raise RobotFileError(
            robot, "this process has not read this model: load a configuration that names its file"
        )
    try:
        spec = parse_model(robot.file, files)
        _refuse(robot, _joint_problems(spec))
        # MuJoCo warns of a model that it cannot simulate, in the middle of other lines.
        with warnings.catch_warnings(category=UserWarning, action="error"):
            model = spec.copy().compile()
    except (ValueError, mujoco.FatalError, UserWarning) as error:
        raise RobotFileError(robot, f"MuJoCo refuses it: {error}") from None
    _refuse(robot, _number_problems(model))
    _refuse(robot, _computing_problems(model))
    return spec


def _refuse(robot: MjcfRobotConfig, problems: Iterator[str]) -> None:
    """Raise an error that tells the first of the problems, if there is one."""
    if problem := next(problems, None):
        raise RobotFileError(robot, problem)


def _joint_problems(spec: mujoco.MjSpec) -> Iterator[str]:
    """Tell what MuJoCo would compile with a warning, and then not simulate."""
    for joint in spec.joints:
        for name in ("armature", "damping", "frictionloss"):
            if (least := float(np.min(getattr(joint, name)))) < 0.0:
                yield f"{joint.name or 'a joint'} has the {name} {least:g}: it should be 0 or more"


def _computing_problems(model: mujoco.MjModel) -> Iterator[str]:
    """Tell what C MuJoCo computes of a robot and MJX leaves out, unsaid."""
    for name, what in _ONLY_IN_C.items():
        if np.any(getattr(model, name)):
            yield f"MJX does not compute {what}: leave it out"
    limited = model.actuator_forcelimited.any() or model.jnt_actfrclimited.any()
    if limited and model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        yield (
            "with the integrator implicitfast MJX does not compute motors at their limits"
            " (forcerange, actuatorfrcrange) as MuJoCo does: leave the integrator out"
        )


def _number_problems(model: mujoco.MjModel) -> Iterator[str]:
    """Tell with which numbers a robot cannot be simulated, such as those in other units."""
    for name in ("body_mass", "body_inertia", "body_pos", "jnt_pos", "geom_pos", "geom_size"):
        if not np.isfinite(getattr(model, name)).all():
            part, _, what = name.partition("_")
            yield f"the {what} of a {_PARTS[part]} is infinite: give a finite number"
    for name in ("body_pos", "jnt_pos", "geom_pos", "geom_size"):
        if (farthest := float(np.abs(getattr(model, name)).max(initial=0.0))) > _LARGEST_LENGTH:
            part, _, what = name.partition("_")
            yield (
                f"the {what} of a {_PARTS[part]} has a length of {farthest:.3g} m: lengths are in"
                " metres (millimetres are metres × 0.001)"
            )
    for name in _SOLREFS:
        first, second = (getattr(model, name) > 0.0).T
        if np.any(first != second):
            yield (
                f"a {name.partition('_')[0]} has a solref of which one number is above 0 and one is"
                " not: give two above 0, or two below"
            )
    if (mass := float(model.body_mass.sum())) > _LARGEST_MASS:
        yield f"it weighs {mass:,.0f} kg: masses are in kilograms (grams are kilograms × 0.001)"
    if not model.opt.gravity[2] < 0.0:
        gravity = " ".join(f"{x:g}" for x in model.opt.gravity)
        yield (
            f"its gravity is ({gravity}), which does not hold it on the floor: (0 0 -9.81) is right"
        )


def parse_model(file: str, files: Mapping[str, bytes]) -> mujoco.MjSpec:
    """Return the model of a file and of those that it names.

    Args:
      file: name of the model.
      files: its content, and that of the files that it names.

    Raises:
      ValueError: MuJoCo refuses it.
    """
    # MuJoCo refuses a name that is in both, also if the folders differ.
    models = {name: content for name, content in files.items() if name.endswith(".xml")}
    assets = {name: content for name, content in files.items() if name not in models}
    return mujoco.MjSpec.from_string(files[file].decode(), include=models, assets=assets)


def find_base(robot: MjcfRobotConfig, spec: mujoco.MjSpec) -> mujoco.MjsBody:
    """Return the body that moves freely.

    Args:
      robot: the section `robot`.
      spec: its model.

    Raises:
      RobotFileError: there is none, there are several, or it is not that of `robot.base`.
    """
    free = [
        body
        for body in spec.worldbody.bodies
        if any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)
    ]
    _refuse(robot, _base_problems(robot, free))
    return next(body for body in free if robot.base in (None, body.name))


def _base_problems(robot: MjcfRobotConfig, free: Sequence[mujoco.MjsBody]) -> Iterator[str]:
    """Tell why none of the bodies with a free joint is the robot's base."""
    names = [body.name for body in free]
    if not free:
        yield (
            "no body of the world has a free joint, so that the robot cannot move: add <freejoint/>"
            " to its base"
        )
    if "" in names:
        yield "the body with a free joint has no name: give it one"
    if any(body.frame is not None for body in free):
        yield "the body with a free joint is in a <frame>: put it into <worldbody> itself"
    if robot.base is None and len(free) > 1:
        yield (
            f"{len(free)} bodies have a free joint ({', '.join(names)}): name the robot's by"
            " robot.base, and leave the others out"
        )
    if robot.base is not None and robot.base not in names:
        yield (
            f"robot.base = {robot.base!r} is no body of the world with a free joint: there is"
            f" {', '.join(names)}"
        )


def add_robot(scene: mujoco.MjSpec, robot: MjcfRobotConfig) -> None:
    """Attach a robot to a scene, whose floor takes the friction of the model's own.

    Args:
      scene: the scene, with a plane `floor`.
      robot: the section `robot`.

    Raises:
      RobotFileError: the model cannot be used.
    """
    spec = load_spec(robot)
    base = find_base(robot, spec)
    name = base.name
    # What the angles of its pose in the file would otherwise overrule when it is set to its rest.
    base.alt.type, base.quat = mujoco.mjtOrientation.mjORIENTATION_QUAT, (1.0, 0.0, 0.0, 0.0)
    planes = [one for one in spec.worldbody.geoms if one.type == mujoco.mjtGeom.mjGEOM_PLANE]
    others = [one for one in spec.worldbody.bodies if one.name != name]
    others += [one for one in spec.worldbody.geoms if one not in planes]
    if others:
        named = ", ".join(one.name or f"a {_kind(one)} without a name" for one in others)
        raise RobotFileError(
            robot, f"{named} is beside the robot: scenery belongs to a task's build_scene"
        )
    floor = scene.geom("floor")
    floor.contype = floor.conaffinity = 1
    for plane in planes:
        for attribute in ("friction", "condim", "priority", "solref", "solimp", "solmix"):
            setattr(floor, attribute, getattr(plane, attribute))
    # No observation is a sensor's.
    needless = (*planes, *spec.worldbody.cameras, *spec.worldbody.lights, *spec.keys, *spec.sensors)
    for element in needless:
        spec.delete(element)
    scale = max(1.0, _extent(spec, name) / _DRAWN_EXTENT)
    _take_options(scene, spec)
    try:
        scene.attach(spec, prefix=PREFIX, frame=scene.worldbody.add_frame())
    except (ValueError, mujoco.FatalError) as error:
        raise RobotFileError(robot, f"it does not fit into the scene: {error}") from None
    body = scene.body(PREFIX + name)
    for camera, (place, down, fovy) in _VIEWS.items():
        body.add_camera(name=camera, pos=scale * np.array(place), quat=_ahead(down), fovy=fovy)


def _kind(part: mujoco.MjsBody | mujoco.MjsGeom) -> str:
    return "body" if isinstance(part, mujoco.MjsBody) else "geom"


def _take_options(scene: mujoco.MjSpec, spec: mujoco.MjSpec) -> None:
    """Give a scene the options of a model that the section `physics` does not decide.

    All others of the model become those of the scene: MuJoCo would print each that differs.
    """
    scene.option.disableflags |= spec.option.disableflags
    for name in _OPTIONS_OF_MODEL:
        setattr(scene.option, name, getattr(spec.option, name))
    looks = [name for name in dir(scene.visual) if not name.startswith("_")]
    parts = [(spec.option, scene.option)]
    parts += [(getattr(spec.visual, name), getattr(scene.visual, name)) for name in looks]
    for own, scenes in parts:
        for name in dir(scenes):
            if not name.startswith("_"):
                setattr(own, name, getattr(scenes, name))
    for name in dir(scene):
        if name in _SIZES or name.startswith("nuser"):
            setattr(spec, name, getattr(scene, name))


def _extent(spec: mujoco.MjSpec, base: str) -> float:
    """Return how far a robot reaches from its base [m]."""
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    own = model.body_rootid[model.geom_bodyid] == model.body(base).id
    reach = np.linalg.norm(data.geom_xpos[own] - data.body(base).xpos, axis=1)
    return float((reach + model.geom_rbound[own]).max(initial=0.0))


def _ahead(down: float) -> Float[np.ndarray, "4"]:
    """Return the attitude of a camera that looks ahead, and down by an angle [°]."""
    sine, cosine = np.sin(np.radians(down)), np.cos(np.radians(down))
    axes = np.stack([(0.0, -1.0, 0.0), (sine, 0.0, cosine), (-cosine, 0.0, sine)], axis=1)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    return quat
