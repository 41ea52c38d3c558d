"""Tell what a robot is, how it follows its commands, and how fast it is simulated."""

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import mujoco
import numpy as np

from jetbot_mjx.config import MjcfRobotConfig, RobotConfig
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.drive import AckermannDrive, DifferentialDrive, OwnDrive
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.mjcf_robot import PREFIX, load_spec
from jetbot_mjx.envs.robot_trial import Trial, drive_trial, trial_turn
from jetbot_mjx.envs.task import reach_on_floor
from jetbot_mjx.envs.wrappers import wrap_for_training

_STEPS = 64
"""Steps of a call whose rate is measured."""

_WELL = 0.05
"""Largest share by which a robot may turn less or more than it is told, without a hint."""

_WIDEST = 2.0
"""Largest separation of wheels that a configuration may have [m]."""

_TRIES = 6
"""Separations of wheels that are tried before one is proposed."""

_DAMPED = 0.6
"""Power of the turn by which the next one differs: turns grow by up to its square."""

_OVERSHOOTS = 2.0
"""Time steps per time constant of a motor from which Euler's method is unstable."""

_VEERS = 0.03
"""Yaw rate straight ahead from which a robot's sides are said to differ [rad/s]."""

_BADLY = 0.3
"""Share from which a training is told so."""

_HORIZONS = (2.3, 3.5)
"""Horizons of the discounting that half a turn may take, with the proposed one and at most. After a
million steps a six-wheeled rover reached 100 % of the goals with 2.3 of them, 98 % with 3.8, and
7 % with 9.4."""

_SPARE = 1.6
"""Length of the proposed episode, in times to the farthest goal: a policy that learns is slow."""


def describe_robot(env: JetBotEnv) -> Iterator[tuple[str, str]]:
    """Yield what the robot is, and how it follows its commands, as a label and a text each.

    Args:
      env: one environment, unwrapped.
    """
    drive, model = env.drive, env.physics.mj_model
    mass = float(model.body_subtreemass[model.jnt_bodyid[0]])
    height = float(model.qpos0[2])
    yield "robot", f"{env.robot.label}: {mass:.3g} kg, its body {1e3 * height:.3g} mm up at rest"
    trial = env.trial or drive_trial(env.config, model, drive)
    if trial is None or isinstance(drive, OwnDrive):
        yield "drive", f"{drive.action_size} numbers, by a function of its own"
        return
    top = env.config.task.max_speed
    yield "speed", f"{trial.speed * top:.3g} m/s of task.max_speed = {top:g}"
    if isinstance(drive, AckermannDrive):
        yield "turn", f"circles of {1.0 / (trial.turn * drive.max_curvature):.3g} m"
    else:
        wheels = f"wheels of {1e3 * drive.wheel_radius:.3g} mm"
        yield "wheels", f"{wheels}, {1e3 * drive.wheel_separation:.3g} mm apart for the controller"
        yield "turn", f"{trial.turn:.0%} of the yaw rate that is commanded"
    if (reach := reach_on_floor(env.task, height)) is not None:
        yield "goals", f"reached within {1e3 * reach:.3g} mm on the floor"
    for hint in (*_driving_hints(env, trial, _WELL), *_simulation_hints(env)):
        yield "hint", hint


def training_hints(env: JetBotEnv) -> list[str]:
    """Return the settings without which a robot of a user's own may not learn.

    Args:
      env: one environment, unwrapped.

    Raises:
      UserError: it does not follow its commands at all.
    """
    trial = env.trial
    if isinstance(env.robot, RobotConfig) and env.robot.label != env.robot.preset:
        trial = drive_trial(env.config, env.physics.mj_model, env.drive)
    if trial is None:
        return []
    return [*_driving_hints(env, trial, _BADLY), *_simulation_hints(env)]


def _driving_hints(env: JetBotEnv, trial: Trial, least: float) -> Sequence[str]:
    """Return what would make a robot follow its commands, and reach its goals.

    Args:
      env: one environment, unwrapped.
      trial: how the robot follows its commands.
      least: the share by which its speed or turn may differ without a hint.
    """
    if held := [*_slow_hint(env, trial), *_veer_hint(env, trial)]:
        return held
    follows = [*_speed_hint(env, trial, least)] or _turn_hint(env, trial, least)
    return [*follows, *_goal_hints(env, trial)]


def _slow_hint(env: JetBotEnv, trial: Trial) -> Iterator[str]:
    """Yield what may hold a robot of a model, which is far slower than it is told.

    Args:
      env: one environment, unwrapped.
      trial: how the robot follows its commands.
    """
    if not isinstance(env.robot, MjcfRobotConfig) or trial.speed >= 1.0 - _BADLY:
        return
    model = env.physics.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    driven = {model.jnt_bodyid[model.actuator_trnid[i, 0]] for i in range(model.nu)}
    drags = [
        f"{model.geom(max(x.geom)).name.removeprefix(PREFIX) or 'a geom'} ({x.friction[0]:g})"
        for x in data.contact
        if model.geom_bodyid[max(x.geom)] not in driven
    ]
    touching = f" (beside the wheels, with their friction: {', '.join(drags[:3])})" * bool(drags)
    yield (
        f"the robot drives with {trial.speed:.0%} of the speed that is commanded: its wheels slip,"
        f" its motors are too weak, a joint's damping or an equality holds it, or a part drags on"
        f" the floor{touching}"
    )


def _veer_hint(env: JetBotEnv, trial: Trial) -> Iterator[str]:
    """Yield that a robot of a model does not drive straight ahead.

    Args:
      env: one environment, unwrapped.
      trial: how the robot follows its commands.
    """
    if isinstance(env.robot, MjcfRobotConfig) and abs(trial.veer) > _VEERS:
        yield (
            f"told to drive straight ahead, the robot turns by {math.degrees(trial.veer):.0f}°"
            " each second: its sides differ, as by a wheel that drags or has no motor, or by the"
            " centre of mass"
        )


def _speed_hint(env: JetBotEnv, trial: Trial, least: float) -> Iterator[str]:
    """Yield which radius of the controller would make a robot as fast as it is told.

    Args:
      env: one environment, unwrapped, whose robot may be one of measures.
      trial: how the robot follows its commands.
      least: as for `_turn_hint`, which has the next hint where this one is followed.
    """
    drive = env.drive
    if isinstance(env.robot, MjcfRobotConfig) or not isinstance(drive, DifferentialDrive):
        return
    if abs(trial.speed - 1.0) <= least:
        return
    fits = float(f"{drive.wheel_radius * trial.speed:.3g}")
    tried = drive_trial(env.config, env.physics.mj_model, drive._replace(wheel_radius=fits))
    # Motors that are too weak are so with every radius.
    if tried is not None and abs(tried.speed - 1.0) <= _WELL:
        yield (
            f"the robot drives with {trial.speed:.0%} of the speed that is commanded:"
            f" robot.controller_wheel_radius = {fits:g} would make that {tried.speed:.0%}"
        )


def _turn_hint(env: JetBotEnv, trial: Trial, least: float) -> Iterator[str]:
    """Yield which separation of wheels would make a robot turn as it is told.

    Args:
      env: one environment, unwrapped.
      trial: how the robot follows its commands.
      least: the share by which it may turn less or more without a hint.
    """
    drive = env.drive
    if isinstance(drive, AckermannDrive | OwnDrive) or trial.turn <= _WELL:
        return
    if abs(trial.turn - 1.0) <= least:
        return
    own = isinstance(env.robot, MjcfRobotConfig)
    key = "wheel_separation" if own else "controller_wheel_separation"
    # A robot that skids does not turn in proportion: try what is proposed.
    fits, turn = drive.wheel_separation, trial.turn
    tried: list[tuple[float, float, float]] = []
    for _ in range(_TRIES):
        fits = min(float(f"{fits * max(turn, _WELL) ** -_DAMPED:.2g}"), _WIDEST)
        turn = trial_turn(env.physics.mj_model, drive._replace(wheel_separation=fits))
        tried.append((abs(turn - 1.0), fits, turn))
    _, fits, turn = min(tried)
    yield (
        f"the robot turns with {trial.turn:.0%} of the yaw rate that is commanded:"
        f" robot.{key} = {fits:.2g} would make that {turn:.0%}"
    )


def _goal_hints(env: JetBotEnv, trial: Trial) -> Iterator[str]:
    """Yield what keeps a robot from the farthest goal, unless the task has goals of its own.

    Args:
      env: one environment, unwrapped.
      trial: how the robot follows its commands.
    """
    task, drive = env.config.task, env.drive
    reach = reach_on_floor(env.task, float(env.mj_model.qpos0[2]))
    if reach is None or isinstance(drive, OwnDrive):
        return
    speed = trial.speed * task.max_speed
    of_car = isinstance(drive, AckermannDrive)
    most = speed * drive.max_curvature if of_car else drive.max_yaw_rate
    half = math.pi / (trial.turn * most)
    farthest = task.goal_distance_min + task.goal_distance_span
    seconds, limit = half + (farthest - reach) / speed, task.episode_length * env.dt
    if seconds > limit:
        steps = math.ceil(_SPARE * seconds / env.dt / 64) * 64
        yield (
            f"a goal {farthest:g} m to the rear takes {seconds:.2g} s, and an episode ends after"
            f" {limit:.2g} s: task.episode_length = {steps} would be enough"
        )
    proposed, most_horizons = _HORIZONS
    if half * (1.0 - env.config.ppo.discounting) > most_horizons * env.dt:
        yield (
            f"half a turn takes {half:.2g} s, beyond the horizon of ppo.discounting ="
            f" {env.config.ppo.discounting:g}: {1.0 - proposed * env.dt / half:.3g} would reach"
            " further"
        )


def _simulation_hints(env: JetBotEnv) -> Iterator[str]:
    """Yield what makes the simulation of a robot inexact or slow.

    Args:
      env: one environment, unwrapped.
    """
    model, drive = env.physics.mj_model, env.drive
    if isinstance(drive, DifferentialDrive | AckermannDrive):
        yield from _motor_hint(model, drive)
    if isinstance(env.robot, MjcfRobotConfig):
        yield from _mesh_hint(model)
        if load_spec(env.robot).option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
            yield "contacts have a pyramidal cone in training, not the elliptic one of the model"
    yield from _contact_hint(model)


def _motor_hint(model: mujoco.MjModel, drive: DifferentialDrive | AckermannDrive) -> Iterator[str]:
    """Yield which motors overshoot, in a step of Euler's method, where a wheel has no grip.

    Args:
      model: the compiled scene, with the robot.
      drive: the robot's drive.
    """
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        return
    step = model.opt.timestep
    found = []
    for wheel in drive.driven if isinstance(drive, AckermannDrive) else drive.wheels:
        index = wheel.actuator
        dof = model.jnt_dofadr[model.actuator_trnid[index, 0]]
        gain = -model.actuator_biasprm[index, 2] * model.actuator_gear[index, 0] ** 2  # [N m s]
        # Euler's method damps joints with the speed after the step, motors with that before it.
        inertia = model.dof_M0[dof] + step * model.dof_damping[dof]
        if step * (gain + model.dof_damping[dof]) > _OVERSHOOTS * inertia:
            name = model.actuator(index).name.removeprefix(PREFIX)
            found.append((inertia / gain, name, step * gain - inertia))
    if found:
        constant, name, missing = min(found)
        yield (
            f"the motor of {name}{' and others' * (len(found) > 1)} chatters where the wheel slips"
            f" or leaves the floor: it changes the wheel's speed within {1e3 * constant:.2g} ms,"
            f" and physics.sim_dt is {1e3 * step:.2g} ms. An armature of {missing:.1e} kg m² more,"
            " a smaller kv or a shorter physics.sim_dt corrects it"
        )


def _mesh_hint(model: mujoco.MjModel) -> Iterator[str]:
    """Yield which meshes may touch the floor otherwise than in C MuJoCo.

    Args:
      model: the compiled scene, with the robot.
    """
    floor = model.geom("floor").id
    meshes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).tolist()
    names = [model.geom(x).name.removeprefix(PREFIX) for x in meshes if _may_touch(model, floor, x)]
    if names:
        named = ", ".join(name or "a mesh" for name in names[:3])
        yield (
            f"where {named}{' and others' * (len(names) > 3)} touches the floor, MJX has other"
            " points of contact than C MuJoCo: a box, spheres, capsules or a cylinder in its place"
            " have the same"
        )


def _contact_hint(model: mujoco.MjModel) -> Iterator[str]:
    """Yield which contacts make a step slow, and may be needless.

    Args:
      model: the compiled scene, with the robot.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    floor = model.geom("floor").id
    own = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.jnt_bodyid[0]).tolist()
    pairs = sum(_may_touch(model, one, other) for one, other in itertools.combinations(own, 2))
    idle = [x for x in own if _may_touch(model, floor, x) and x not in data.contact.geom]
    names = ", ".join(model.geom(x).name.removeprefix(PREFIX) or "a geom" for x in idle[:3])
    parts = [f"{pairs} pair{'s' * (pairs > 1)} of the robot's own parts"] * bool(pairs)
    parts += [f"{names}{' and others' * (len(idle) > 3)} with the floor"] * bool(idle)
    if parts:
        yield (
            f"each step looks for contacts of {' and of '.join(parts)}, which costs: give what only"
            ' shows contype="0" conaffinity="0", and what touches the floor alone conaffinity="0"'
        )


def _may_touch(model: mujoco.MjModel, one: int, other: int) -> bool:
    """Return whether MuJoCo looks for contacts of two geoms, unless the scene names the pair."""
    bodies = model.body_weldid[model.geom_bodyid[[one, other]]]
    parents = model.body_weldid[model.body_parentid[bodies]]
    related = bool(bodies.min()) and (bodies[0] == parents[1] or bodies[1] == parents[0])
    types, affinities = model.geom_contype[[one, other]], model.geom_conaffinity[[one, other]]
    meets = bool((types & affinities[::-1]).any())
    return meets and bool(bodies[0] != bodies[1]) and not related


def step_rate(env: JetBotEnv | AdaptedEnv, instances: int) -> float:
    """Return the environment steps per second of many instances, rounded to two digits.

    Args:
      env: one environment, unwrapped. The images of a robot are left out; an environment of one's
        own is in the wrappers of a training.
      instances: the number of instances, which run on JAX's default device.
    """
    if isinstance(env, AdaptedEnv):
        batch = wrap_for_training(env, env.config.task.episode_length)
        reset, step = batch.reset, batch.step
    else:
        reset, step = jax.vmap(env.blind().reset), jax.vmap(env.blind().step)
    keys = jax.random.split(jax.random.PRNGKey(0), instances)
    states = jax.jit(reset)(keys)
    actions = jax.random.uniform(keys[0], (instances, env.action_size), minval=-1.0)

    @jax.jit
    def drive(states: Any) -> Any:
        return jax.lax.fori_loop(0, _STEPS, lambda _, x: step(x, actions), states)

    jax.block_until_ready(drive(states))
    begin = time.perf_counter()
    jax.block_until_ready(drive(states))
    return float(f"{instances * _STEPS / (time.perf_counter() - begin):.2g}")
