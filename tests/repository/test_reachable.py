"""No controller is faster than the bound, be it of the abstract motion or of the simulator."""

import json

import numpy as np
import pytest

from benchmarks.learning.reachable import ERROR_TIME, Grid, Limits, farthest, least_steps
from jetbot_mjx.evaluation.best_known import BOUND_FILE, FILE
from tests.helpers.limits import PLAIN

SPINNING = PLAIN._replace(
    swing=4.0,
    drag=0.013,
    outer_loss=0.02,
    inner_loss=0.006,
    brake=1.3,
    growth=1.5,
    max_yaw_rate=5.5,
    spun_step=0.07,
    slip=0.02,
    max_wheel_speed=0.8,
)
STEPS = 40


def places(limits: Limits, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the positions (time, n, 2) of speeds and yaw rates (time, n)."""
    late, dt, ones = limits.lateness, limits.ctrl_dt, np.ones((1, v.shape[1]))
    heading = np.cumsum(
        np.concatenate([0 * ones, dt * ((1 - late) * w[:-1] + late * w[1:])]), axis=0
    )
    cos, sin, aside = np.cos(heading), np.sin(heading), -limits.slip * v * w
    velocity = np.stack([v * cos - aside * sin, v * sin + aside * cos], axis=-1)
    moves = dt * ((1 - late) * velocity[:-1] + late * velocity[1:])
    return np.concatenate([np.zeros((1, v.shape[1], 2)), np.cumsum(moves, axis=0)])


def motions(limits: Limits, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return speeds and yaw rates (time, n) that keep to the limits: turn, then drive, or wander.

    Each robot wants a yaw rate and a speed, which it changes at random times, and gets as much of
    both as the limits allow, the turn first.
    """
    rng, dt, g = np.random.default_rng(seed), limits.ctrl_dt, limits.track
    v, w, all_v, all_w = np.zeros(count), np.zeros(count), [], []
    begins, ends = rng.integers(0, STEPS, (2, count))
    side, slow = rng.choice([-1.0, 1.0], count), rng.uniform(0, 1, count)
    wanders, lets = rng.uniform(size=(2, count)) < 0.5
    turn, fast = side * limits.motor_yaw_rate, np.zeros(count)
    for t in range(STEPS + 1):
        all_v.append(v)
        all_w.append(w)
        again = wanders & (rng.uniform(size=count) < 0.1)
        turn = np.where(again, rng.uniform(-1, 1, count) * limits.motor_yaw_rate, turn)
        turn = np.where(~wanders & (t >= ends), 0, turn)
        fast = np.where(wanders | (t >= begins), 1, slow * (slow > 0.7)) * limits.max_speed
        both, apart = limits.outer_loss + limits.inner_loss, limits.outer_loss - limits.inner_loss
        grown = limits.growth * np.sign(w) * (np.abs(w) > limits.motor_yaw_rate)
        drift_w = (limits.swing * v * w - np.sign(w) * apart / 2 / g * v * w**2 + grown) * dt
        drift_v = -(limits.drag + both / 2 * v) * w**2 * dt
        most = limits.step / g
        torque = np.clip(turn - w - drift_w, -most, most)
        # Above the motors' yaw rate, some let the turn grow by itself.
        grows = lets & (np.abs(turn) == limits.motor_yaw_rate) & (torque * w < 0)
        nw = w + drift_w + np.where(grows & (np.abs(w) < 0.8 * limits.max_yaw_rate), 0, torque)
        left = limits.step - g * np.abs(nw - w - drift_w)
        fast = np.minimum(fast, limits.max_wheel_speed - limits.half_track * np.abs(nw))
        nv = v + drift_v + np.clip(fast - v - drift_v, -left, left)
        nv = np.clip(nv, 0, None)
        v, w = nv, nw
    return np.stack(all_v), np.stack(all_w)


# It turns faster and faster by itself.
GROWING = PLAIN._replace(growth=4.0, max_yaw_rate=12.0, swing=0.2)


@pytest.mark.parametrize(
    ("limits", "grid"),
    [
        (PLAIN, Grid(1, 48)),
        (PLAIN, Grid(2, 36)),
        (PLAIN, Grid(7, 36)),
        (SPINNING, Grid(1, 48)),
        (SPINNING, Grid(2, 36)),
        (GROWING, Grid(2, 36)),
    ],
    ids=["plain-1", "plain-2", "plain-7", "spinning-1", "spinning-2", "growing-2"],
)
def test_no_motion_within_the_limits_gets_farther(limits, grid):
    table = farthest(limits, STEPS, grid)
    angles = np.arange(grid.headings) * 2 * np.pi / grid.headings
    directions = np.stack([np.cos(angles), np.sin(angles)])
    most = np.full_like(table, -1.0)
    for seed in range(4):
        reached = places(limits, *motions(limits, seed, 4096)) @ directions
        most = np.maximum(most, reached.max(axis=1))
    assert (most <= table + 1e-9).all()
    # They are not far from it, so that a bound which is too low would be found.
    assert (table - most)[-1].max() < 0.18


def test_no_robot_that_spins_gets_farther():
    """Beyond the limits, velocities turn to any side as fast as the grip allows."""
    limits = SPINNING._replace(max_turn=0.9, grip=4.0)
    table = farthest(limits, STEPS, Grid(2, 48))
    v, w = motions(limits, 0, 4096)
    path, dt = places(limits, v, w), limits.ctrl_dt
    heading = np.cumsum(dt * (0.25 * w[:-1] + 0.75 * w[1:]), axis=0)
    heading = np.concatenate([np.zeros((1, 4096)), heading])
    begins = (v * np.abs(w) > limits.max_turn).argmax(axis=0)
    spun = np.flatnonzero(begins)[::8]
    assert spun.size > 60
    closest = np.inf
    for angle in np.arange(48) * 2 * np.pi / 48:
        for one in spun:
            start = begins[one]
            a, speed, turn = heading[start, one], v[start, one], w[start, one]
            aside = -limits.slip * speed * turn
            along = speed * np.cos(a - angle) - aside * np.sin(a - angle)
            steps = np.arange(STEPS + 1 - start)
            fast = np.hypot(speed, aside) + limits.spun_step * steps
            rate = np.minimum(along + limits.grip * dt * steps, np.minimum(fast, limits.max_speed))
            moved = np.cumsum(dt * (0.25 * rate[:-1] + 0.75 * rate[1:]))
            far = path[start, one] @ [np.cos(angle), np.sin(angle)] + moved
            room = table[start + 1 :, round(angle * 24 / np.pi)] - far
            assert room.min(initial=1.0) >= 0
            closest = min(closest, room[5:].min(initial=1.0))
    # Some come close, so that a value which is too low would be found.
    assert closest < 0.03


def test_a_robot_that_spins_gets_as_far_as_the_grip_allows():
    # It spins as soon as it turns at all, and then moves backwards as well.
    limits, steps = SPINNING._replace(max_turn=1e-6, grip=1.5, swing=0.0), 14
    table = farthest(limits, steps, Grid(4, 144))
    speed = limits.grip * limits.ctrl_dt * np.arange(steps + 1)
    exact = limits.ctrl_dt * (np.cumsum(speed) - (1 - limits.lateness) * speed)
    # The first step is needed for the turn.
    assert (table[1:, 72] >= exact[:-1]).all()
    assert table[-1, 72] <= 1.4 * exact[-1]


def test_straight_ahead_it_is_the_time_of_full_acceleration():
    table = farthest(PLAIN, STEPS, Grid(2, 72))
    time = np.arange(STEPS + 1)
    speed = np.minimum(PLAIN.step * time, PLAIN.max_speed)
    exact = PLAIN.ctrl_dt * (np.cumsum(speed) - (1 - PLAIN.lateness) * speed)
    assert (table[:, 0] >= exact).all()
    assert table[-1, 0] <= 1.03 * exact[-1]


def test_backwards_takes_the_time_of_the_turn():
    table = farthest(PLAIN, STEPS, Grid(2, 72))
    # A quarter of a turn at 3 rad/s, less what the lattice and the drift of speed give away.
    steps = np.flatnonzero(table[:, 36] > 0.02)[0]
    assert steps * PLAIN.ctrl_dt > 0.95 * np.pi / 2 / PLAIN.motor_yaw_rate


def test_an_error_of_the_positions_is_added():
    table = farthest(PLAIN, 4, Grid(1, 8))
    more = farthest(PLAIN._replace(error=0.01), 4, Grid(1, 8))
    time = np.arange(1, 5) * PLAIN.ctrl_dt + ERROR_TIME
    np.testing.assert_allclose(
        (more - table)[1:], np.broadcast_to(0.01 * time[:, None], (4, 8)), rtol=1e-4
    )


def test_steps_to_a_goal():
    # Ahead 0.1 m a step, nowhere else.
    table = np.array([[0.1 * t, 0, 0, 0] for t in range(6)])
    goals = np.array([[0.05, 0.0], [0.15, 0.0], [0.45, 0.0], [0.0, 0.09], [0.0, 0.3]])
    assert least_steps(table, goals, 0.1).tolist() == [0, 1, 4, 0, 6]


# What the package stores.


def stored(file):
    searches = json.loads(file.read_text())["searches"]
    return {json.dumps(one["settings"]): one for one in searches}


def test_no_search_is_faster():
    known, bounds = stored(FILE), stored(BOUND_FILE)
    assert known.keys() == bounds.keys()
    for name, bound in bounds.items():
        assert bound["goals"] == known[name]["goals"]
        gaps = np.array(known[name]["steps"]) / np.array(bound["steps"]) - 1
        assert gaps.min() >= 0
        assert np.median(gaps) < 0.0505
