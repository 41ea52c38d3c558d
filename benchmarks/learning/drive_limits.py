"""Measure the limits of a robot's motion, which its lower bound of the time to a goal rests on.

Inertia comes from the model's mass matrix. How fast wheels speed up and brake, and how far the
motion of a real contact differs from that of rolling wheels, is measured in many drives by
commands that switch, wander and ramp, with a margin.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.learning.reachable import ERROR_TIME, Limits
from jetbot_mjx.envs import QPOS_QUAT, QPOS_XYZ, DifferentialDrive, JetBotEnv, PhysicsState

MARGIN = 1.005
"""Factor between the largest measured value and the limit."""

MARGIN_OF_SPEED = 1.003
"""The same for speeds, which the motors' controller holds closely."""

_MARGIN_OF_ERROR = 1.2
GROWTH = 0.9  # [rad/s²] by which |ω| may grow faster than by the drift
_SPIN = 1.5  # largest yaw rate with limits, as a multiple of the commanded one; then wheels slip


class Motion(NamedTuple):
    """A `Motion` holds drives of a robot, at each control step; the first is at rest."""

    position: Float[np.ndarray, "n t 3"]
    """Position of the axle midpoint [m]."""
    speed: Float[np.ndarray, "n t"]
    """Speed ahead [m/s]."""
    sideways: Float[np.ndarray, "n t"]
    """Speed to the left [m/s]."""
    yaw_rate: Float[np.ndarray, "n t"]
    """Yaw rate [rad/s]."""


def random_actions(seed: int, count: int, steps: int, size: int = 2) -> np.ndarray:
    """Return actions that switch between the ends, wander, turn then drive, or ramp.

    Args:
      seed: the seed.
      count: the number of drives.
      steps: the control steps of each.
      size: the length of an action.
    """
    rng, time = np.random.default_rng(seed), np.arange(steps)
    actions = np.empty((count, steps, size), np.float32)
    for i in range(count):
        hold = int(rng.integers(1, 40))
        held = rng.uniform(-1, 1, (steps // hold + 1, size))
        if i % 4 == 0:
            actions[i] = np.repeat(np.sign(held), hold, axis=0)[:steps]
        elif i % 4 == 1:
            actions[i] = np.repeat(held, hold, axis=0)[:steps]
        elif i % 4 == 2:
            begins, ends = rng.integers(0, steps // 2, (2, size))
            first, then = rng.choice([-1.0, 0.0, 1.0], (2, size))
            actions[i] = np.where(time[:, None] < begins, first, then)
            actions[i, : ends[0], 1] = rng.choice([-1.0, 1.0])
        else:
            corners = rng.choice([-1.0, -0.5, 0.0, 0.5, 1.0], (8, size))
            places = np.linspace(0, 7, steps)
            actions[i] = np.stack([np.interp(places, range(8), x) for x in corners.T], axis=-1)
    return actions


def drive(env: JetBotEnv, actions: Float[np.ndarray, "n t action"]) -> Motion:
    """Drive robots by open-loop actions.

    Args:
      env: one environment, unwrapped.
      actions: the actions of each robot.
    """
    first = env.reset(jax.random.PRNGKey(0)).pipeline_state

    def one(actions: jax.Array) -> PhysicsState:
        def step(state: PhysicsState, action: jax.Array) -> tuple[PhysicsState, PhysicsState]:
            nstate = env.physics.step(state, env.drive.controls(env.wheel_targets(action)))
            return nstate, nstate

        after = jax.lax.scan(step, first, actions)[1]
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, after)

    states = jax.jit(jax.vmap(one))(jnp.asarray(actions))
    return motion(np.asarray(states.qpos, float), np.asarray(states.qvel, float))


def motion(qpos: Float[np.ndarray, "n t nq"], qvel: Float[np.ndarray, "n t nv"]) -> Motion:
    """Return the motion on the floor of generalised positions and velocities."""
    w, x, y, z = np.moveaxis(qpos[..., QPOS_QUAT], -1, 0)
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    (vx, vy), (wx, wy, wz) = np.moveaxis(qvel[..., :2], -1, 0), np.moveaxis(qvel[..., 3:6], -1, 0)
    turning = 2 * (x * z - w * y) * wx + 2 * (y * z + w * x) * wy + (1 - 2 * (x * x + y * y)) * wz
    ahead, left = np.cos(yaw) * vx + np.sin(yaw) * vy, np.cos(yaw) * vy - np.sin(yaw) * vx
    return Motion(qpos[..., QPOS_XYZ], ahead, left, turning)


class Inertia(NamedTuple):
    """An `Inertia` holds constants of a robot whose wheels roll."""

    track: float
    """g [m], as of `Limits`, like the other fields."""
    swing: float
    drag: float
    half_track: float


def inertia(env: JetBotEnv) -> Inertia | str:
    """Return the constants of a robot with wheels on two sides, or why there are none."""
    if not isinstance(env.drive, DifferentialDrive):
        return "the robot has no wheels on two sides"
    model = env.physics.mj_model
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    # How all coordinates move with the speed and the yaw rate.
    rolling = np.zeros((model.nv, 2))
    rolling[0, 0] = rolling[5, 1] = 1.0
    places = []
    for actuator in range(model.nu):
        joint = model.actuator_trnid[actuator, 0]
        body, dof = model.jnt_bodyid[joint], model.jnt_dofadr[joint]
        y, radius = float(data.xpos[body, 1]), float(data.xpos[body, 2])
        sign = np.sign(env.drive.wheels[actuator].gain) if env.drive.wheels else 1.0
        rolling[dof] = sign / radius, -sign * y / radius
        places.append(abs(y))
    (heavy, _), (_, round_) = rolling.T @ mass @ rolling
    behind, half = -mass[1, 5], float(np.mean(places))
    return Inertia(round_ / (heavy * half), behind / round_, behind / heavy, half)


def sides(constants: Inertia, moved: Motion, ctrl_dt: float) -> Float[np.ndarray, "2 n t"]:
    """Return by how much p and q grow in each step besides their drift [m/s].

    The first is that of the outer side, the second that of the inner one, in a turn.
    """
    v, w = moved.speed, moved.yaw_rate
    sign = np.where(w[:, :-1] < 0, -1.0, 1.0)
    grown, turned = np.diff(v), sign * constants.track * np.diff(w)
    v, w = v[:, :-1], np.abs(w[:, :-1])
    swing = constants.swing * constants.track * v * w * ctrl_dt
    drag = constants.drag * w**2 * ctrl_dt
    return np.stack([grown + turned - swing + drag, grown - turned + swing + drag])


def path(moved: Motion, limits: Limits) -> Float[np.ndarray, "n t 2"]:
    """Return the positions that follow from speeds and yaw rates alone [m]."""
    dt, late = limits.ctrl_dt, limits.lateness
    v, w = moved.speed, moved.yaw_rate
    turns = dt * ((1 - late) * w[:, :-1] + late * w[:, 1:])
    heading = np.concatenate([np.zeros_like(w[:, :1]), np.cumsum(turns, axis=1)], axis=1)
    aside = -limits.slip * v * w
    cos, sin = np.cos(heading), np.sin(heading)
    velocity = np.stack([v * cos - aside * sin, v * sin + aside * cos], axis=-1)
    moves = dt * ((1 - late) * velocity[:, :-1] + late * velocity[:, 1:])
    return np.concatenate([np.zeros_like(velocity[:, :1]), np.cumsum(moves, axis=1)], axis=1)


def lateness(env: JetBotEnv) -> float:
    """Return the share of a control step in which velocities are as at its end.

    MuJoCo moves by the new velocity in each of the physics steps, and velocities change evenly.
    """
    return 0.5 + 0.5 / env.config.physics.n_substeps


def highest(moved: Motion) -> float:
    """Return the largest height of the axle midpoint [m]."""
    return float(moved.position[..., 2].max())


def measure(env: JetBotEnv, whole: Motion) -> Limits | str:
    """Measure the limits of a robot's motion.

    Args:
      env: one environment, unwrapped.
      whole: drives of the robot, at least as long as the bound has to hold.

    Returns:
      The limits, or why there are none, in one line.
    """
    constants, dt = inertia(env), env.dt
    if isinstance(constants, str) or not isinstance(env.drive, DifferentialDrive):
        return str(constants)
    w, v = np.abs(whole.yaw_rate), whole.speed
    # Beyond the largest yaw rate only the speed is limited, for the rest of the drive.
    most = _SPIN * env.drive.max_yaw_rate
    spins = float(w.max()) > most
    calm = np.maximum.accumulate(w, axis=1) <= most
    before = calm[:, :-1]
    # The motors' yaw rate is the largest that |ω| reaches faster than by the drift.
    drifted = w[:, :-1] * (1 + max(constants.swing, 0) * np.maximum(v[:, :-1], 0) * dt)
    driven = (w[:, 1:] > drifted + GROWTH * dt) & calm[:, 1:]
    motors = MARGIN * float(w[:, 1:][driven].max())
    if not spins:
        motors = most = max(motors, MARGIN * float(w.max()))
    grown = sides(constants, whole, dt)
    step = MARGIN * max(float(grown[:, before].max()), _growth_after(whole, ~calm))
    curve = v * w
    slip = -float((whole.sideways * v * whole.yaw_rate)[calm].sum() / (curve[calm] ** 2).sum())
    limits = Limits(
        ctrl_dt=dt,
        track=constants.track,
        step=step,
        brake=MARGIN * max(1.0, float(-grown[:, before].min()) / step),
        swing=constants.swing,
        drag=constants.drag,
        max_speed=MARGIN_OF_SPEED * float(v.max()),
        min_speed=MARGIN * min(float(v[calm].min()), 0.0),
        motor_yaw_rate=motors,
        growth=GROWTH if spins else 0.0,
        max_yaw_rate=most,
        half_track=constants.half_track,
        max_wheel_speed=MARGIN_OF_SPEED * float((v + constants.half_track * w)[calm].max()),
        lateness=lateness(env),
        slip=slip,
        error=0.0,
    )
    apart = np.linalg.norm(path(whole, limits) - whole.position[..., :2], axis=-1) * calm
    time = np.arange(apart.shape[1]) * dt
    return limits._replace(error=_MARGIN_OF_ERROR * float((apart / (time + ERROR_TIME)).max()))


def _growth_after(moved: Motion, spun: Bool[np.ndarray, "n t"]) -> float:
    """Return by how much the speed on the floor grows in a step on average, once it spins."""
    speed, most = np.hypot(moved.speed, moved.sideways), 0.0
    for one, here in zip(speed, spun, strict=True):
        rest = one[here]
        steps = np.arange(1, rest.size)
        most = max(most, float(((rest[1:] - rest[0]) / steps).max())) if rest.size > 1 else most
    return most
