"""The limits of a robot's motion hold in drives by other commands than they were measured with."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.learning.drive_limits import (
    MARGIN,
    Gains,
    Inertia,
    Motion,
    drive,
    errors,
    follow,
    inertia,
    measure,
    motion,
    nearest,
    once_spun,
    path,
    random_actions,
    sides,
    within,
)
from benchmarks.learning.reachable import ERROR_TIME, Grid, Limits, farthest, least_steps
from jetbot_mjx.config import load_config
from jetbot_mjx.envs import make_jetbot_env
from jetbot_mjx.evaluation.best_known import BOUND_FILE
from tests.helpers.limits import PLAIN

LIMITS = PLAIN._replace(
    ctrl_dt=0.01, step=0.03, max_speed=1.0, max_wheel_speed=9.0, lateness=0.5, slip=0.02
)

CONFIGS = {"isaac": "jetbot", "real": "real_jetbot"}


def test_actions_are_actions_of_all_kinds():
    actions = random_actions(3, 64, 50)
    assert actions.shape == (64, 50, 2)
    assert np.abs(actions).max() <= 1
    assert (np.abs(actions[::6]) == 1).all()
    # The last kind alternates one action alone.
    assert (np.diff(actions[5::6, :, 0], axis=1) == 0).all()
    assert (np.abs(np.diff(actions[5::6, :, 1], axis=1)).max(axis=1) == 2).any()
    np.testing.assert_array_equal(actions, random_actions(3, 64, 50))


def test_motion_is_in_the_frame_of_the_robot():
    # A robot that looks to the left, drives ahead, slides to its left and turns.
    half = np.sqrt(0.5)
    qpos, qvel = np.zeros((1, 1, 9)), np.zeros((1, 1, 8))
    qpos[..., :7] = 1.0, 2.0, 0.03, half, 0.0, 0.0, half
    qvel[..., :6] = -0.2, 0.7, 0.0, 0.0, 0.0, 1.5
    moved = motion(qpos, qvel)
    assert moved.speed.item() == pytest.approx(0.7)
    assert moved.sideways.item() == pytest.approx(0.2)
    assert moved.yaw_rate.item() == pytest.approx(1.5)
    assert moved.heading.item() == pytest.approx(np.pi / 2)
    assert moved.position.ravel().tolist() == [1.0, 2.0, 0.03]


def test_the_inertia_of_the_jetbot():
    robot = load_config("jetbot").robot
    found = inertia(make_jetbot_env("jetbot"))
    _, spin, across = robot.moments_of_wheel
    turning = 2 * (spin + robot.armature) / robot.wheel_radius**2
    half = robot.wheel_separation / 2
    heavy = robot.chassis_mass + 2 * robot.wheel_mass + turning
    round_ = (
        robot.moments_of_chassis[2]
        + robot.chassis_mass * robot.chassis_com[0] ** 2
        + 2 * (across + robot.wheel_mass * half**2)
        + turning * half**2
    )
    moment = -robot.chassis_mass * robot.chassis_com[0]
    by_hand = round_ / (heavy * half), moment / round_, moment / heavy, half
    # The model's wheels are pressed a little into the floor.
    np.testing.assert_allclose(found, by_hand, rtol=0.03)


def test_a_car_has_none():
    assert inertia(make_jetbot_env("car")) == "the robot has no wheels on two sides"


def test_without_torque_neither_side_grows():
    constants, dt = Inertia(0.05, 4.0, 0.013, 0.06), 0.01
    v, w = [0.5], [-3.0]
    for _ in range(20):
        v, w = (
            [*v, v[-1] - constants.drag * w[-1] ** 2 * dt],
            [*w, w[-1] * (1 + constants.swing * v[-1] * dt)],
        )
    zeros = np.zeros((1, 21))
    moved = Motion(np.zeros((1, 21, 3)), np.array([v]), zeros, np.array([w]), zeros)
    np.testing.assert_allclose(sides(constants, moved, dt), 0, atol=1e-12)
    # Torque of the right wheel alone: in a turn to the right that is the inner one.
    w = np.array([w])
    w[0, 1:] += 0.1
    outer, inner = sides(constants, moved._replace(yaw_rate=w, speed=np.array([v])), dt)
    assert (outer[0, 0], inner[0, 0]) == (pytest.approx(-0.005), pytest.approx(0.005))


def test_a_path_follows_from_speeds_and_yaw_rates():
    time = np.arange(101) * 0.01
    v, w = np.full((1, 101), 0.6), np.full((1, 101), 2.0)
    moved = Motion(np.zeros((1, 101, 3)), v, np.zeros((1, 101)), w, np.zeros((1, 101)))
    turn, aside = 2.0 * time, 0.02 * 0.6 * 2.0 / 2.0
    x = 0.3 * np.sin(turn) + aside * (1 - np.cos(turn))
    y = 0.3 * (1 - np.cos(turn)) - aside * np.sin(turn)
    np.testing.assert_allclose(path(moved, LIMITS)[0], np.stack([x, y], axis=1), atol=1e-4)


def _rolling(speed, yaw_rate, limits):
    """Return drives whose places follow from their rates."""
    zeros, late = np.zeros_like(speed), limits.lateness
    turns = limits.ctrl_dt * ((1 - late) * yaw_rate[:, :-1] + late * yaw_rate[:, 1:])
    heading = np.concatenate([zeros[:, :1], np.cumsum(turns, axis=1)], axis=1)
    moved = Motion(np.zeros((*speed.shape, 3)), speed, zeros, yaw_rate, heading)
    moved.position[..., :2] = path(moved, limits)
    return moved


def _wild():
    rng = np.random.default_rng(2)
    speed, yaw_rate = rng.uniform(0, 1, (2, 64, 60)) * [[[1.0]], [[4.0]]]
    speed[:, 0] = yaw_rate[:, 0] = 0
    limits = LIMITS._replace(swing=4.0, drag=0.013, outer_loss=0.02, inner_loss=0.01)
    return _rolling(speed, yaw_rate, limits), limits


@pytest.mark.parametrize(
    "gains", [Gains(0.0, 0.0, 0.0, early=False), Gains(10.0, 3.0, 2.0, early=True)]
)
def test_a_drive_within_the_limits_follows_any_other(gains):
    wild, limits = _wild()
    near = follow(wild, limits, gains)
    # Both sides keep to the step, besides the drift and what the turn takes.
    constants = Inertia(limits.track, limits.swing, limits.drag, limits.half_track)
    lost = limits.ctrl_dt * (near.speed * near.yaw_rate**2)[:, :-1]
    outer, inner = sides(constants, near, limits.ctrl_dt)
    assert np.abs(outer + limits.outer_loss * lost).max() <= limits.step + 1e-9
    assert np.abs(inner + limits.inner_loss * lost).max() <= limits.step + 1e-9
    assert np.abs(near.speed - wild.speed).max() > 0.1
    # Torque does not raise the yaw rate beyond that of the motors.
    fast = near.yaw_rate[:, 1:] > limits.motor_yaw_rate
    drift = 1 + limits.swing * np.maximum(near.speed, 0)[:, :-1] * limits.ctrl_dt
    assert (near.yaw_rate[:, 1:] <= np.maximum(3.0, near.yaw_rate[:, :-1] * drift) + 1e-9)[
        fast
    ].all()
    # What keeps to them is followed exactly.
    near = _rolling(near.speed, near.yaw_rate, limits)
    again = follow(near, limits, gains)
    np.testing.assert_allclose(again.speed, near.speed, atol=1e-9)
    np.testing.assert_allclose(again.yaw_rate, near.yaw_rate, atol=1e-9)


def test_a_following_drive_returns_to_where_the_other_is():
    # A drive that is pushed aside where it could not follow; then it drives on evenly.
    limits = LIMITS._replace(max_wheel_speed=2.0)
    moved = _rolling(np.full((1, 150), 0.5), np.full((1, 150), 0.5), limits)
    moved.position[:, 20:, 1] += 0.02
    moved.speed[:, 0] = moved.yaw_rate[:, 0] = 0.0
    apart = [
        np.linalg.norm(
            path(follow(moved, limits, gains), limits)[0, -1] - moved.position[0, -1, :2]
        )
        for gains in (Gains(0.0, 0.0, 0.0, early=False), Gains(16.0, 6.0, 5.0, early=True))
    ]
    assert apart[0] > 0.02
    assert apart[1] < 0.002


def test_the_nearest_drive_is_the_closest_of_those_that_follow():
    wild, limits = _wild()
    least = errors(wild, nearest(wild, limits), limits).max(axis=1)
    for gains in (
        Gains(0.0, 0.0, 0.0, early=False),
        Gains(40.0, 3.0, 2.0, early=False),
        Gains(16.0, 6.0, 5.0, early=True),
    ):
        one = errors(wild, follow(wild, limits, gains), limits).max(axis=1)
        assert (least <= one + 1e-12).all()
        assert (least < one).any()


def test_errors_count_until_the_step_in_which_a_robot_spins():
    limits = LIMITS._replace(max_yaw_rate=3.0)
    near = _rolling(np.full((1, 6), 0.5), np.array([[0.0, 1.0, 2.0, 4.0, 1.0, 1.0]]), limits)
    moved = near._replace(position=near.position + np.array([0.0, 0.03, 0.0]))
    time = limits.ctrl_dt * np.arange(4) + ERROR_TIME
    expected = [*(0.03 / time), 0.0, 0.0]
    np.testing.assert_allclose(errors(moved, near, limits)[0], expected, rtol=1e-9)


def test_once_a_robot_spins_its_velocity_on_the_floor_changes():
    limits = LIMITS._replace(max_yaw_rate=3.0, slip=0.0)
    near = _rolling(np.full((2, 5), 0.5), np.array([[0, 0, 9.0, 0, 0], [0.0] * 5]), limits)
    # The first robot spins from step 2 on, and drives as before but for a push to the left.
    moved = near._replace(heading=np.zeros((2, 5)), sideways=np.array([[0, 0, 0, 0.1, 0.3]] * 2))
    near = near._replace(yaw_rate=np.array([[0, 0, 9.0, 0, 0], [0.0] * 5]))
    begin = 0.5 * np.array([np.cos(9.0 * 0.005), np.sin(9.0 * 0.005)])
    grip, growth = once_spun(moved, near, limits)
    pushed = np.array([[0.5, 0.1], [0.5, 0.3]])
    changes = np.linalg.norm(pushed - begin, axis=1) / (limits.ctrl_dt * np.array([1, 2]))
    faster = (np.linalg.norm(pushed, axis=1) - 0.5) / np.array([1, 2])
    np.testing.assert_allclose(grip, [changes.max(), 0.0], rtol=1e-9)
    np.testing.assert_allclose(growth, [faster.max(), 0.0], rtol=1e-9)


# In the simulator.


def _stored(preset):
    values = json.loads(BOUND_FILE.read_text())["searches"]
    one = next(one for one in values if one["settings"]["robot.preset"] == preset)
    return Limits(**one["limits"]), one["reach"]


def _shares(driven, limits):
    """Return, by its name, how much of each limit every drive uses."""
    near = nearest(driven, limits)
    calm = within(near, limits.max_yaw_rate, limits.max_turn)
    wheel = near.speed + limits.half_track * np.abs(near.yaw_rate)
    speed = np.where(calm, near.speed, np.hypot(driven.speed, driven.sideways))
    shares = {
        "error": errors(driven, near, limits).max(axis=1) / limits.error,
        "max_speed": speed.max(axis=1) / limits.max_speed,
        "min_speed": (near.speed * calm).min(axis=1) / limits.min_speed,
        "max_wheel_speed": (wheel * calm).max(axis=1) / limits.max_wheel_speed,
    }
    if np.isinf(limits.max_turn):
        return shares | {"max_yaw_rate": np.abs(near.yaw_rate).max(axis=1) / limits.max_yaw_rate}
    grip, growth = once_spun(driven, near, limits)
    return shares | {"grip": grip / limits.grip, "spun_step": growth / limits.spun_step}


@pytest.mark.slow
@pytest.mark.parametrize("preset", CONFIGS)
def test_other_drives_keep_to_the_limits_and_never_beat_the_bound(preset):
    # The bound of the isaac robot holds for as many steps as its farthest goal takes.
    env, steps = make_jetbot_env(load_config(CONFIGS[preset])), 100 if preset == "isaac" else 150
    limits, reach = _stored(preset)
    driven = drive(env, random_actions(77, 2048, steps))
    found = measure(env, driven)
    assert isinstance(found, Limits)
    assert found.step / MARGIN <= limits.step
    assert found.motor_yaw_rate / MARGIN <= limits.motor_yaw_rate
    for name, share in _shares(driven, limits).items():
        assert share.max() <= 1, name
    # On this floor and two others.
    table = farthest(limits, steps, Grid(2 if preset == "isaac" else 4, 60))
    angles = np.arange(60) * 2 * np.pi / 60
    directions = np.stack([np.cos(angles), np.sin(angles)])
    rng = np.random.default_rng(5)
    distance, bearing = rng.uniform(0.15, 1.2, 2048), rng.uniform(-np.pi, np.pi, 2048)
    goals = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)
    least = least_steps(table, goals, reach)
    for friction in (1.0, 0.4, 1.5):
        one = (
            env
            if friction == 1.0
            else make_jetbot_env(load_config(CONFIGS[preset], [f"robot.friction={friction}"]))
        )
        moved = driven if friction == 1.0 else drive(one, random_actions(78, 1024, steps))
        # Per step, no drive is beyond the bound in any direction: so it is for every goal.
        most = np.full_like(table, -1.0)
        for place in moved.position[..., :2]:
            np.maximum(most, place @ directions, out=most)
        # The limits are of friction 1: on a slippery floor a robot slides 0.5 mm farther at first.
        assert (most <= table + (1e-3 if friction < 1 else 0.0)).all()
        # The 2,048 goals, by the fastest drives of a few.
        for place in moved.position[:64, :, :2]:
            ahead = np.linalg.norm(place[:, None] - goals, axis=-1) < reach
            assert (ahead.argmax(axis=0) >= least)[ahead.any(axis=0)].all()


@pytest.mark.slow
def test_optimised_commands_do_not_beat_the_bound():
    """The cross-entropy method pulls polylines of actions farthest along a few directions."""
    env, steps, knots = make_jetbot_env("jetbot"), 80, 10
    limits, _ = _stored("isaac")
    table = farthest(limits, steps, Grid(2, 72))
    first, rng = env.reset(jax.random.PRNGKey(0)).pipeline_state, np.random.default_rng(0)

    @jax.jit
    @jax.vmap
    def end(actions):
        def step(state, action):
            return env.physics.step(state, env.drive.controls(env.wheel_targets(action))), None

        return jax.lax.scan(step, first, actions)[0].qpos[:2]

    places = np.linspace(0, knots - 1, steps)
    hats = np.maximum(1 - np.abs(places[:, None] - np.arange(knots)), 0)
    for direction in range(0, 72, 9):
        angle = 2 * np.pi * direction / 72
        mean, spread = np.zeros((knots, 2)), np.ones((knots, 2))
        for _ in range(12):
            drawn = mean + spread * rng.standard_normal((512, knots, 2))
            ends = np.asarray(end(jnp.asarray(hats @ drawn, jnp.float32)))
            far = ends @ [np.cos(angle), np.sin(angle)]
            best = drawn[np.argsort(-far)[:32]]
            mean, spread = best.mean(axis=0), np.maximum(best.std(axis=0), 0.02)
            assert far.max() <= table[steps, direction]
        assert far.max() > 0.6 * table[steps, direction] - 0.1


@pytest.mark.slow
@pytest.mark.parametrize("preset", CONFIGS)
def test_optimised_commands_keep_to_the_limits(preset):
    """The cross-entropy method looks for commands that use most of each limit."""
    env, steps, pieces = make_jetbot_env(load_config(CONFIGS[preset])), 104, 9
    limits, _ = _stored(preset)
    rng, time = np.random.default_rng(1), np.arange(104)
    names = ["error", "min_speed", "error" if preset == "real" else "grip"]
    mean, spread = np.zeros((3, pieces, 3)), np.full((3, pieces, 3), 1.5)
    for _ in range(24):
        # Pieces of constant actions; the last number makes a piece long.
        drawn = mean[:, None] + spread[:, None] * rng.standard_normal((3, 192, pieces, 3))
        long = np.exp(np.clip(drawn[..., 2], -4, 4))
        ends = steps * np.cumsum(long, axis=-1) / long.sum(axis=-1, keepdims=True)
        piece = (time[:, None] >= ends[:, :, None, :-1]).sum(axis=-1)
        actions = np.take_along_axis(np.clip(drawn[..., :2], -1, 1), piece[..., None], axis=2)
        shares = _shares(drive(env, actions.reshape(-1, steps, 2).astype(np.float32)), limits)
        for name, share in shares.items():
            assert share.max() <= 1, name
        for i, name in enumerate(names):
            best = drawn[i][np.argsort(-shares[name][192 * i : 192 * (i + 1)])[:24]]
            mean[i], spread[i] = best.mean(axis=0), np.maximum(best.std(axis=0), 0.1)
