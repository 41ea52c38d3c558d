"""Measure the limits of a robot's motion, which its lower bound of the time to a goal rests on.

Inertia comes from the model's mass matrix. How fast wheels speed up and brake, and how far the
motion of a real contact differs from that of rolling wheels, is measured in many drives by
commands that switch, wander, ramp and alternate, with a margin.
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

_MARGIN_OF_SPEED = 1.003  # the same for speeds, which the motors' controller holds closely

_MARGIN_OF_SPUN = 1.3  # the same for what is rare: backwards, or after a robot has spun

_MARGIN_OF_ERROR = 2.5  # a search for commands finds some that are farther apart

# Chosen; `Limits.error` is measured with them.
GROWTH = 0.45  # [rad/s²] by which |ω| may grow faster than by the drift
_SPIN = 1.9  # largest yaw rate with limits, as a multiple of the commanded one
_TURN = 1.4  # largest v |ω| with limits, as a multiple of that of the commanded speeds
_DRIVEN = 0.1  # of the largest change of the yaw rate: more is that of motors
_SHARE = 0.977  # of the largest measured change of speed, which lasts for single steps only
_OUTER_LOSS, _INNER_LOSS = 1.0, 0.6  # of `Limits.slip`

_BEND = 0.2  # [rad] by which a drive that follows another heads for its place at most


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
    heading: Float[np.ndarray, "n t"]
    """Angle of the robot's front to the x axis [rad]."""


def random_actions(seed: int, count: int, steps: int, size: int = 2) -> np.ndarray:
    """Return actions that switch, wander, turn then drive, ramp, or alternate.

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
        if i % 6 == 0:
            actions[i] = np.repeat(np.sign(held), hold, axis=0)[:steps]
        elif i % 6 == 1:
            actions[i] = np.repeat(held, hold, axis=0)[:steps]
        elif i % 6 == 2:
            begins, ends = rng.integers(0, steps // 2, (2, size))
            first, then = rng.choice([-1.0, 0.0, 1.0], (2, size))
            actions[i] = np.where(time[:, None] < begins, first, then)
            actions[i, : ends[0], 1] = rng.choice([-1.0, 1.0])
        elif i % 6 == 3:
            corners = rng.choice([-1.0, -0.5, 0.0, 0.5, 1.0], (8, size))
            places = np.linspace(0, 7, steps)
            actions[i] = np.stack([np.interp(places, range(8), x) for x in corners.T], axis=-1)
        elif i % 6 == 4:
            # Many at the ends, each held as long as it happens.
            pieces = int(rng.integers(4, 13))
            place = np.searchsorted(np.sort(rng.uniform(0, steps, pieces - 1)), time)
            actions[i] = np.clip(1.5 * rng.standard_normal((pieces, size)), -1, 1)[place]
        else:
            # All but one action stay; that one alternates, from some time on.
            actions[i] = rng.choice([-1.0, 1.0], size)
            turns = time // int(rng.integers(1, 12)) % 2 * 2 - 1
            actions[i, :, -1] = np.where(time < rng.integers(0, steps), 1.0, turns)
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
    return Motion(qpos[..., QPOS_XYZ], ahead, left, turning, yaw)


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


def nearest(moved: Motion, limits: Limits) -> Motion:
    """Return drives that keep to limits of torque and motors, each the closest of some to another.

    Any drive that keeps to the limits will do, so each is followed with several `Gains`.
    """
    best, least = moved, np.full(len(moved.speed), np.inf)
    for gains in _GAINS:
        near = follow(moved, limits, gains)
        most = errors(moved, near, limits).max(axis=1)
        closer = most < least
        speed = np.where(closer[:, None], near.speed, best.speed)
        yaw_rate = np.where(closer[:, None], near.yaw_rate, best.yaw_rate)
        best, least = moved._replace(speed=speed, yaw_rate=yaw_rate), np.minimum(most, least)
    return best


def errors(moved: Motion, near: Motion, limits: Limits) -> Float[np.ndarray, "n t"]:
    """Return how far drives are from those that follow them, as `Limits.error` counts it [m/s].

    It is zero after the step in which the following robot begins to spin.
    """
    apart = np.linalg.norm(path(near, limits) - moved.position[..., :2], axis=-1)
    time = np.arange(apart.shape[1]) * limits.ctrl_dt + ERROR_TIME
    counts = np.ones(apart.shape, bool)
    counts[:, 1:] = within(near, limits.max_yaw_rate, limits.max_turn)[:, :-1]
    return np.where(counts, apart / time, 0)


class Gains(NamedTuple):
    """A `Gains` says how strongly a drive that follows another corrects what it is off."""

    heading: float
    """[1/s] of the heading."""
    across: float
    """[rad/m] of the place across, by the heading."""
    along: float
    """[1/s] of the place along."""
    early: bool
    """Whether it begins early what is too fast for it."""


_GAINS = [
    Gains(heading, across, along, early)
    for heading in (0.0, 6.0, 16.0, 40.0)
    for across, along in ((3.0, 2.0), (6.0, 5.0), (3.0, 8.0), (10.0, 8.0))
    for early in (False, True)
]


def follow(moved: Motion, limits: Limits, gains: Gains) -> Motion:
    """Return drives that keep to limits of torque and motors, and follow others closely."""
    late, both = limits.lateness, np.zeros((2, *moved.speed.shape))
    headings = np.unwrap(moved.heading, axis=1) - moved.heading[:, :1]
    wanted = np.stack([moved.speed, moved.yaw_rate])
    wanted = _early(moved, limits) if gains.early else wanted
    speed, yaw_rate = moved.speed[:, 0], moved.yaw_rate[:, 0]
    place, heading = np.zeros((len(speed), 2)), np.zeros_like(speed)

    def move(to_speed: np.ndarray, to_rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the place and the heading after a step that ends with these rates."""
        begin = _velocity(speed, yaw_rate, heading, limits)
        turned = heading + limits.ctrl_dt * ((1 - late) * yaw_rate + late * to_rate)
        end = _velocity(to_speed, to_rate, turned, limits)
        return place + limits.ctrl_dt * ((1 - late) * begin + late * end), turned

    for t in range(1, moved.speed.shape[1]):
        now = headings[:, t]
        aim_speed, aim_rate = wanted[:, :, t]
        # How far would it be off with the same rates?
        after, turned = move(aim_speed, aim_rate)
        apart = moved.position[:, t, :2] - after
        off = _on_floor(apart[:, 0], apart[:, 1], -now)
        bend = np.clip(gains.across * off[:, 1] * np.sign(aim_speed), -_BEND, _BEND)
        rate = aim_rate + gains.heading * (now - turned + bend)
        room = (limits.max_wheel_speed - aim_speed) / limits.half_track
        fastest = np.maximum(np.abs(aim_rate), np.minimum(limits.motor_yaw_rate, room))
        rate = np.clip(rate, -fastest, fastest)
        # The speed is none that the robot could not have.
        room = limits.max_wheel_speed - limits.half_track * np.abs(rate)
        most = np.minimum(limits.max_speed, room)
        ahead = np.clip(aim_speed + gains.along * off[:, 0], np.minimum(aim_speed, 0), most)
        ends = _torque(speed, yaw_rate, ahead, rate, limits)
        place, heading = move(*ends)
        speed, yaw_rate = both[:, :, t] = ends
    return moved._replace(speed=both[0], yaw_rate=both[1])


def _velocity(
    speed: np.ndarray, yaw_rate: np.ndarray, heading: np.ndarray, limits: Limits
) -> np.ndarray:
    """Return the velocity on the floor of a robot that slips in turns [m/s]."""
    return _on_floor(speed, -limits.slip * speed * yaw_rate, heading)


def _early(moved: Motion, limits: Limits) -> Float[np.ndarray, "2 n t"]:
    """Return speeds and yaw rates of a drive that begins early what is too fast for the limits."""
    v, w = moved.speed, moved.yaw_rate
    drifted = _drifted(v[:, :-1], w[:, :-1], limits)
    sides = np.stack([v + limits.track * w, v - limits.track * w])
    grown, before = sides[:, :, 1:] - drifted, np.zeros_like(sides)
    # Backwards in time: by how much must a side be faster than in the other drive, so that all
    # that follows can be reached?
    for t in range(v.shape[1] - 2, 0, -1):
        needed = grown[:, :, t] + before[:, :, t + 1]
        low, high = needed - limits.step, needed + limits.brake * limits.step
        before[:, :, t] = np.clip(0, low, high)
    p, q = sides + before
    return np.stack([(p + q) / 2, (p - q) / 2 / limits.track])


def _torque(
    v: np.ndarray, w: np.ndarray, ahead: np.ndarray, rate: np.ndarray, limits: Limits
) -> np.ndarray:
    """Return speeds and yaw rates after a control step towards others, within the limits."""
    track, most = limits.track, limits.step
    p, q = _drifted(v, w, limits)
    # The torque that comes closest; it does not raise |ω| beyond the motors' yaw rate.
    a = np.clip(ahead + track * rate - p, -limits.brake * most, most)
    b = np.clip(ahead - track * rate - q, -limits.brake * most, most)
    room = np.maximum(2 * track * limits.motor_yaw_rate - np.abs(p - q), 0)
    beyond = np.sign(p - q) * np.maximum(np.sign(p - q) * (a - b) - room, 0) / 2
    p, q = p + a - beyond, q + b + beyond
    return np.stack([(p + q) / 2, (p - q) / 2 / track])


def _drifted(v: np.ndarray, w: np.ndarray, limits: Limits) -> np.ndarray:
    """Return p and q after a control step without torque."""
    dt, track = limits.ctrl_dt, limits.track
    sign, lost = np.sign(w), np.maximum(v, 0) * w**2
    swing = limits.swing * v * w * track
    outer, inner = limits.outer_loss * lost, limits.inner_loss * lost
    grows = 2 * track * limits.growth * (np.abs(w) > limits.motor_yaw_rate)
    slowed = limits.drag * w**2
    p = v + track * w
    p = p + dt * (swing - slowed - np.where(sign > 0, outer, inner) + grows * (sign > 0))
    q = v - track * w
    q = q + dt * (-swing - slowed - np.where(sign < 0, outer, inner) + grows * (sign < 0))
    return np.stack([p, q])


def path(moved: Motion, limits: Limits) -> Float[np.ndarray, "n t 2"]:
    """Return the positions that follow from speeds and yaw rates alone [m]."""
    velocity = velocities(moved, limits)
    moves = _steps(velocity, limits)
    return np.concatenate([np.zeros_like(velocity[:, :1]), np.cumsum(moves, axis=1)], axis=1)


def velocities(moved: Motion, limits: Limits) -> Float[np.ndarray, "n t 2"]:
    """Return the velocities on the floor that follow from speeds and yaw rates alone [m/s]."""
    turns = _steps(moved.yaw_rate, limits)
    heading = np.concatenate([np.zeros_like(turns[:, :1]), np.cumsum(turns, axis=1)], axis=1)
    return _velocity(moved.speed, moved.yaw_rate, heading, limits)


def _steps(rate: np.ndarray, limits: Limits) -> np.ndarray:
    """Return by how much each control step changes what has these rates at its ends."""
    late = limits.lateness
    return limits.ctrl_dt * ((1 - late) * rate[:, :-1] + late * rate[:, 1:])


def _on_floor(ahead: np.ndarray, left: np.ndarray, heading: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([ahead * cos - left * sin, ahead * sin + left * cos], axis=-1)


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
    # Where it spins, only velocities are limited, for the rest of the drive.
    most = _SPIN * env.drive.max_yaw_rate
    spins = float(w.max()) > most
    turn = _TURN * env.drive.max_yaw_rate * env.drive.max_speed if spins else np.inf
    calm = within(whole, most, turn)
    most_grown = float(sides(constants, whole, dt)[:, calm[:, :-1]].max())
    # The motors' yaw rate is the largest that |ω| reaches clearly faster than by the drift.
    drifted = w[:, :-1] * (1 + max(constants.swing, 0) * np.maximum(v[:, :-1], 0) * dt)
    driven = (w[:, 1:] > drifted + _DRIVEN * most_grown / constants.track) & calm[:, 1:]
    motors = MARGIN * float(w[:, 1:][driven].max())
    if not spins:
        motors, most = max(motors, MARGIN * float(w.max())), np.inf
    curve = v * w
    slip = -float((whole.sideways * v * whole.yaw_rate)[calm].sum() / (curve[calm] ** 2).sum())
    limits = Limits(
        ctrl_dt=dt,
        track=constants.track,
        step=MARGIN * _SHARE * most_grown,
        brake=1.0,
        swing=constants.swing,
        drag=constants.drag,
        outer_loss=_OUTER_LOSS * slip,
        inner_loss=_INNER_LOSS * slip,
        max_speed=float(v.max()),
        min_speed=0.0,
        motor_yaw_rate=motors,
        growth=GROWTH if spins else 0.0,
        max_yaw_rate=most,
        max_turn=turn,
        grip=0.0,
        spun_step=0.0,
        half_track=constants.half_track,
        max_wheel_speed=float((v + constants.half_track * w)[calm].max()),
        lateness=lateness(env),
        slip=slip,
        error=0.0,
    )
    return _with_the_rest(whole, limits)


def _with_the_rest(whole: Motion, limits: Limits) -> Limits:
    """Return limits with those of speeds, the grip and the error, of drives that keep to them."""
    near = nearest(whole, limits)
    calm = within(near, limits.max_yaw_rate, limits.max_turn)
    on_floor = np.where(calm, near.speed, np.hypot(whole.speed, whole.sideways))
    fastest = _MARGIN_OF_SPEED * max(float(whole.speed.max()), float(on_floor.max()))
    slowest = _MARGIN_OF_SPUN * min(float(near.speed[calm].min()), 0.0)
    wheel = near.speed + limits.half_track * np.abs(near.yaw_rate)
    grip, growth = once_spun(whole, near, limits)
    if np.isinf(limits.max_yaw_rate):
        widest = max(limits.motor_yaw_rate, float(np.abs(near.yaw_rate).max()))
        limits = limits._replace(motor_yaw_rate=widest, max_yaw_rate=widest)
    return limits._replace(
        max_speed=fastest,
        min_speed=slowest,
        max_wheel_speed=MARGIN * float(wheel[calm].max()),
        grip=_MARGIN_OF_SPUN * float(grip.max()),
        spun_step=_MARGIN_OF_SPUN * float(growth.max()),
        error=_MARGIN_OF_ERROR * float(errors(whole, near, limits).max()),
    )


def within(moved: Motion, max_yaw_rate: float, max_turn: float) -> Bool[np.ndarray, "n t"]:
    """Return until when each drive keeps to the largest yaw rate, and v |ω| to its limit."""
    w = np.abs(moved.yaw_rate)
    return np.logical_and.accumulate((w <= max_yaw_rate) & (moved.speed * w <= max_turn), axis=1)


def once_spun(
    whole: Motion, near: Motion, limits: Limits
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return by how much velocity and speed change on the floor, on average since a robot spins.

    Args:
      whole: drives.
      near: the drives that follow them, which tell when the robots begin to spin.
      limits: the limits; only those of the path and of the yaw rate are used.

    Returns:
      The largest change of the velocity [m/s²], and of the speed in a control step [m/s].
    """
    velocity = _on_floor(whole.speed, whole.sideways, whole.heading)
    calm = within(near, limits.max_yaw_rate, limits.max_turn)
    grip, growth = np.zeros((2, len(velocity)))
    for i, (now, begin) in enumerate(zip(velocity, velocities(near, limits), strict=True)):
        start = int(calm[i].sum())
        steps = np.arange(1, len(now) - start)
        if steps.size:
            first, rest = begin[start], now[start + 1 :]
            grip[i] = (np.linalg.norm(rest - first, axis=-1) / steps).max() / limits.ctrl_dt
            faster = np.linalg.norm(rest, axis=-1) - np.linalg.norm(first)
            growth[i] = (faster / steps).max()
    return grip, growth
