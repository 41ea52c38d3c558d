"""Bound how far a robot gets in a time, from the limits of its motion.

The bound holds for every controller, as long as the robot's motion keeps its `Limits`; the page
`docs/lower-bound.md` states the theorem and its proof. `lower_bound.py` computes from it the least
number of steps to each of the report's goals.

With the speed v and the yaw rate ω of a robot, p = v + g ω and q = v - g ω behave like the speeds
of its right and left wheels: each changes by at most `step` in a control step, besides a drift that
the centre of mass causes. A dynamic programme over (heading, p, q) computes the largest distance
that a robot can get in a given direction in a given time. A goal that is farther in any
direction, less the success radius, is not reached.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

ERROR_TIME = 1.0
"""[s] Time before the start from which `Limits.error` counts."""

_NEVER = np.float32(-1e6)  # [m] value of a state that is outside of the limits
_IMPOSSIBLE = -1e3  # [m] values below are made of `_NEVER`
_ROUNDING = 4e-6  # [m] by which float32 may round the value of a state in a step


class Limits(NamedTuple):
    """A `Limits` holds what a robot's motion keeps to in every control step, by any command."""

    ctrl_dt: float
    """[s] duration of a control step."""
    track: float
    """g [m] in p = v + g ω and q = v - g ω."""
    step: float
    """[m/s] largest growth of p and q in a control step, besides the drift."""
    brake: float
    """Largest fall of p and q in a control step, as a multiple of `step`."""
    swing: float
    """κ [1/m] of the drift: ω grows by κ v ω per second without torque."""
    drag: float
    """[m] of the drift: v falls by `drag` ω² per second without torque."""
    outer_loss: float
    """[s] of the drift: in a turn the outer one of p and q falls by `outer_loss` v ω² per second,
    because the wheels slip sideways."""
    inner_loss: float
    """[s] the same of the inner one."""
    max_speed: float
    """[m/s] largest v."""
    min_speed: float
    """[m/s] smallest v, zero or negative."""
    motor_yaw_rate: float
    """[rad/s] yaw rate above which torque does not raise |ω|."""
    growth: float
    """[rad/s²] by which |ω| may grow faster than by the drift where it is above."""
    max_yaw_rate: float
    """[rad/s] yaw rate beyond which only velocities are limited; it is never reached where it
    equals `motor_yaw_rate`."""
    max_turn: float
    """[m/s²] v |ω| beyond which only velocities are limited; infinite if it is never reached."""
    grip: float
    """[m/s²] by which the velocity on the floor may change, from then on."""
    spun_step: float
    """[m/s] by which the speed on the floor may grow in a control step, from then on."""
    half_track: float
    """[m] half of the distance of the wheels."""
    max_wheel_speed: float
    """[m/s] largest v + `half_track` |ω|; infinite if there is no such limit."""
    lateness: float
    """Share of a control step in which a robot moves as at its end; otherwise as at its start."""
    slip: float
    """[s] sideways speed as a multiple of -v ω."""
    error: float
    """[m/s] by which positions may drift from the sum of v and `slip` over all steps, from
    `ERROR_TIME` before the start."""


class Grid(NamedTuple):
    """A `Grid` holds the resolution of the dynamic programme; every one gives a bound."""

    divisions: int = 1
    """Steps of p and q into which `Limits.step` is divided."""
    headings: int = 180
    """Headings over the full circle."""


class _Lattice:
    """A `_Lattice` holds the states (p, q) of a dynamic programme, and what moves them.

    Arrays have the axes (q, p - q, heading). Between the states values are linear on triangles:
    squares of (p, q), divided by lines of constant ω.
    """

    def __init__(self, limits: Limits, grid: Grid) -> None:
        dt, n = limits.ctrl_dt, grid.divisions
        # Align the lattice with the largest speed and with the yaw rate of the motors: round the
        # step up, and the track down, which widens the limits.
        levels = int(np.floor(2 * limits.max_speed * n / limits.step))
        self.width = width = 2 * limits.max_speed / levels
        ranks = int(np.floor(2 * limits.track * limits.motor_yaw_rate / width))
        self.track = ranks * width / 2 / limits.motor_yaw_rate
        self.up, self.down = n, int(np.ceil(n * limits.brake - 1e-9))
        # The last ranks are those from which one step may lead beyond the largest yaw rate.
        free = int(np.ceil(2 * self.track * limits.max_yaw_rate / width))
        grown = free * dt * (limits.swing * limits.max_speed + limits.growth)
        self.spins = limits.max_yaw_rate > limits.motor_yaw_rate
        most = free + int(np.ceil(grown)) if self.spins else ranks
        # Where the drift may lead, and between the torque of one side and of the other.
        most += 3 + max(self.up, self.down)
        low = int(np.ceil(-2 * limits.min_speed / width)) + 1
        self.first = -((low + most) // 2 + 3)
        q = np.arange(self.first, (levels + 1 + most) // 2 + 4)[:, None]
        rank = np.arange(-most, most + 1)[None, :]
        self.rank, twice = rank[0], 2 * q + rank
        self.v, s = np.broadcast_arrays(twice * width / 2, rank * width / 2)
        self.w = s / self.track
        reach = limits.max_wheel_speed + width / 2 * (1 + limits.half_track / self.track)
        self.valid = (twice >= -low) & (twice <= levels + 1)
        self.valid &= self.v + limits.half_track * np.abs(self.w) <= reach
        self.driven = np.abs(self.rank) <= ranks
        self.valid &= self.spins | self.driven
        # A state between those of the lattice is free if one of its neighbours may be.
        sign, size = np.sign(self.w), np.abs(self.w)
        beyond = size + width / 2 / self.track
        self.free = (beyond > limits.max_yaw_rate) & self.spins
        self.free |= (np.abs(self.v) + width) * beyond > limits.max_turn
        # The drift of p and q, in steps of the lattice.
        swing, drag = limits.swing * self.v * s, limits.drag * self.w**2
        lost = np.maximum(self.v, 0) * self.w**2
        outer, inner = drag + limits.outer_loss * lost, drag + limits.inner_loss * lost
        # Already at the motors' yaw rate itself, so that all states above it have it whole.
        grows = 2 * self.track * limits.growth * (size > limits.motor_yaw_rate - 1e-9)
        self.drift_p = (swing - np.where(sign > 0, outer, inner) + grows * (sign > 0)) * dt / width
        self.drift_q = (-swing - np.where(sign < 0, outer, inner) + grows * (sign < 0)) * dt / width


def _at(x: Float[np.ndarray, "q rank *rest"], p: int, q: int) -> Float[np.ndarray, "q rank *rest"]:
    """Return the values of the states that are (p, q) steps of the lattice away."""
    moved, (rows, columns), a, b = np.full_like(x, _NEVER), x.shape[:2], q, p - q
    to = slice(max(0, -a), rows - max(a, 0)), slice(max(0, -b), columns - max(b, 0))
    of = slice(max(0, a), rows + min(0, a)), slice(max(0, b), columns + min(0, b))
    moved[to] = x[of]
    return moved


def _best(x: np.ndarray, down: int, up: int, p: int, q: int) -> np.ndarray:
    """Return the largest value of the states -`down` to `up` times (p, q) away."""
    results = []
    for most, sign in ((up, 1), (down, -1)):
        result, done = x, 1
        while done <= most:
            more = min(done, most + 1 - done)
            result = np.maximum(result, _at(result, sign * more * p, sign * more * q))
            done += more
        results.append(result)
    return np.maximum(*results)


class _Drift:
    """A `_Drift` moves p by a fraction of a step of the lattice, or q if `swapped`.

    Values between the states of the result are no smaller than the true ones: a state gains what
    linear interpolation misses where values are concave across an edge of a triangle.
    """

    def __init__(self, lattice: _Lattice, amount: np.ndarray, *, swapped: bool) -> None:
        rows, columns = amount.shape
        whole = np.floor(amount + 1e-9).astype(int)
        self._swapped, part = swapped, np.clip(amount - whole, 0, 1)
        a, b = (1, -1) if swapped else (0, 1)
        row, column = np.indices(amount.shape)
        self._places = [
            np.clip(row + a * (whole + one), 0, rows - 1) * columns
            + np.clip(column + b * (whole + one), 0, columns - 1)
            for one in (0, 1)
        ]
        self._part = part.astype(np.float32)[..., None]
        # The drift of neighbours differs: by how much at most?
        rate = np.zeros_like(amount)
        for p, q in ((1, 0), (0, 1), (1, 1)):
            for sign in (1, -1):
                both = lattice.valid & (_at(lattice.valid.astype(float), sign * p, sign * q) > 0)
                apart = np.abs(_at(amount, sign * p, sign * q) - amount)
                rate = np.maximum(rate, np.where(both, apart, 0))
        gain = part * (1 - part) / (1 - np.minimum(rate, 0.5))
        self._gain = gain.astype(np.float32)[..., None]

    def _shift(self, x: np.ndarray, p: int, q: int) -> np.ndarray:
        return _at(x, q, p) if self._swapped else _at(x, p, q)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the values after the drift."""
        flat = x.reshape(-1, x.shape[-1])
        low, high = (flat[place] for place in self._places)
        result = low + self._part * (high - low)
        lost = np.minimum(low, high) < _IMPOSSIBLE
        result[lost] = np.maximum(low, high)[lost]
        # How far values are concave across the edges that start at each state.
        right, above, beyond = self._shift(x, 1, 0), self._shift(x, 0, 1), self._shift(x, 1, 1)
        steep = np.maximum(x + above - self._shift(x, -1, 0) - beyond, 0)
        slant = np.maximum(x + beyond - right - above, 0)
        unknown = (x < _IMPOSSIBLE) | (above < _IMPOSSIBLE) | (beyond < _IMPOSSIBLE)
        steep[unknown | (self._shift(x, -1, 0) < _IMPOSSIBLE)] = 0
        slant[unknown | (right < _IMPOSSIBLE)] = 0
        same = steep + slant
        other = np.maximum(self._shift(steep, 1, 0), 0) + slant
        row = np.maximum(np.maximum(self._shift(same, 1, 0), same), other)
        below = np.maximum(np.maximum(same, other), self._shift(other, -1, 0))
        edges = np.maximum(np.maximum(row, self._shift(below, 0, -1)), 0)
        return result + self._gain * edges.reshape(flat.shape)[self._places[0]]


class _Turn:
    """A `_Turn` turns the robot by its yaw rate for one control step; likewise an upper bound."""

    def __init__(self, lattice: _Lattice, ctrl_dt: float, headings: int) -> None:
        angle = 2 * np.pi / headings
        steps = lattice.w[0] * ctrl_dt / angle
        whole = np.floor(steps).astype(int)
        self._places = (np.arange(headings) + whole[:, None]) % headings
        self._next = (self._places + 1) % headings
        self._part = (steps - whole).astype(np.float32)[:, None]
        # A quarter of the angle between neighbours of different yaw rates.
        apart, valid = np.float32((steps[1] - steps[0]) / 4), lattice.valid.astype(np.float32)
        self._pairs = [
            (p, q, (apart * valid * np.maximum(_at(valid, p, q), 0))[..., None])
            for p, q in ((1, 0), (0, -1))
        ]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the values before the turn."""
        bend = np.maximum(2 * x - np.roll(x, 1, 2) - np.roll(x, -1, 2), 0)
        result, slope = np.empty_like(x), np.empty_like(x)
        for rank, (place, after, part) in enumerate(
            zip(self._places, self._next, self._part, strict=True)
        ):
            low, high, concave = x[:, rank, place], x[:, rank, after], bend[:, rank]
            slope[:, rank] = high - low
            most = np.maximum(concave[:, place], concave[:, after])
            result[:, rank] = low + part * (high - low) + part * (1 - part) * most
        # States between two yaw rates turn by an angle between those of both.
        fall = np.zeros_like(x)
        for p, q, apart in self._pairs:
            one = apart * np.maximum(slope - _at(slope, p, q), 0)
            np.maximum(fall, one, out=fall)
            np.maximum(fall, _at(one, -p, -q), out=fall)
        return result + fall


class _Spun:
    """A `_Spun` bounds how far robots get that spin: whose velocities alone are limited."""

    def __init__(self, lattice: _Lattice, limits: Limits, grid: Grid) -> None:
        angle = 2 * np.pi / grid.headings
        self._limits, v, w = limits, lattice.v[lattice.free, None], lattice.w[lattice.free, None]
        # It moves along its heading after the turn of this control step, as in `_gain`.
        headings = np.arange(grid.headings) * angle + w * limits.ctrl_dt * limits.lateness
        # Between the states of the lattice, velocities are larger by this at most.
        apart = lattice.width * (1 + limits.slip * limits.max_yaw_rate)
        apart += limits.max_speed * (angle / 2 + limits.slip * lattice.width / lattice.track)
        self._along = v * np.cos(headings) + limits.slip * v * w * np.sin(headings) + apart
        self._fast = np.abs(v) * np.hypot(1.0, limits.slip * w) + apart
        self._way = self._speed(0) * limits.ctrl_dt

    def _speed(self, step: int) -> np.ndarray:
        """Return the largest speed in the direction after some steps, of each state [m/s]."""
        gained = step * self._limits.grip * self._limits.ctrl_dt
        speed = np.minimum(self._along + gained, self._fast + step * self._limits.spun_step)
        return np.minimum(speed, self._limits.max_speed)

    def __call__(self, step: int) -> np.ndarray:
        """Return the values of the states after `step` steps; call it for 1, 2, and so on."""
        moved = self._speed(step) * self._limits.ctrl_dt
        value = self._way + self._limits.lateness * moved
        self._way = self._way + moved
        return value.astype(np.float32)


def farthest(limits: Limits, steps: int, grid: Grid) -> Float[np.ndarray, "t directions"]:
    """Compute upper bounds of how far a robot gets in each direction in a number of steps.

    Args:
      limits: the limits of its motion; it starts at rest.
      steps: the largest number of control steps.
      grid: the resolution.

    Returns:
      Distances [m] from the start along each of `grid.headings` evenly spaced directions, from
      straight ahead counter-clockwise, after 0 to `steps` control steps.
    """
    lattice, dt = _Lattice(limits, grid), limits.ctrl_dt
    gain = _gain(lattice, limits, grid)
    turn = _Turn(lattice, dt, grid.headings)
    drift_p = _Drift(lattice, lattice.drift_p, swapped=False)
    drift_q = _Drift(lattice, lattice.drift_q, swapped=True)
    spun = ~lattice.driven[None, :, None]
    left = (lattice.rank >= 0)[None, :, None]
    value = np.where(lattice.valid[..., None], limits.lateness * gain, _NEVER).astype(np.float32)
    start = -lattice.first, int(np.flatnonzero(lattice.rank == 0)[0])
    results = np.zeros((steps + 1, grid.headings))
    spun_robot = _Spun(lattice, limits, grid)
    for t in range(steps):
        # Torque below the yaw rate of the motors: p and q change independently.
        wide = _best(np.where(spun, _NEVER, value), lattice.down, lattice.up, 1, 0)
        wide = _best(wide, lattice.down, lattice.up, 0, 1)
        if lattice.spins:  # Torque above it: |ω| does not grow.
            narrow = _no_faster(value, lattice, left)
            wide = np.where(spun, narrow, np.maximum(wide, narrow))
        value = drift_q(drift_p(wide))
        value = turn(value) + gain + np.float32(_ROUNDING)
        value[~lattice.valid] = _NEVER
        if lattice.free.any():
            value[lattice.free] = np.maximum(value[lattice.free], spun_robot(t + 1))
        results[t + 1] = value[start] + limits.error * ((t + 1) * dt + ERROR_TIME)
    # The array is over the heading relative to the direction.
    return np.concatenate([results[:, :1], results[:, :0:-1]], axis=1)


def _gain(lattice: _Lattice, limits: Limits, grid: Grid) -> np.ndarray:
    """Return how far a state moves in the direction in one control step, before its turn [m]."""
    angle = 2 * np.pi / grid.headings
    heading = (
        np.arange(grid.headings) * angle + (lattice.w * limits.ctrl_dt * limits.lateness)[..., None]
    )
    v, w = lattice.v[..., None], lattice.w[..., None]
    moved = v * np.cos(heading) + limits.slip * v * w * np.sin(heading)
    # What linear interpolation between headings, speeds and yaw rates misses.
    bent = limits.max_speed * (1 + limits.slip * limits.max_yaw_rate) * angle**2 / 8
    mixed = lattice.width**2 / lattice.track * (limits.slip + limits.ctrl_dt)
    return ((moved + bent + mixed) * limits.ctrl_dt).astype(np.float32)


def _no_faster(value: np.ndarray, lattice: _Lattice, left: np.ndarray) -> np.ndarray:
    """Return the largest value after torque that does not raise |ω|, by the sign of ω."""
    up, down, results = lattice.up, lattice.down, []
    for inner in ((1, 0), (0, 1)):  # the wheel that is faster must not gain on the other
        best, row = np.full_like(value, _NEVER), np.full_like(value, _NEVER)
        a, b = inner
        for other in range(-down, up + 1):
            np.maximum(row, _at(value, a * other, b * other), out=row)
            np.maximum(best, _at(row, b * other, a * other), out=best)
        results.append(best)
    return np.where(left, *results)


def least_steps(
    table: Float[np.ndarray, "t directions"], goals: Float[np.ndarray, "n 2"], radius: float
) -> Int[np.ndarray, " n"]:
    """Compute a lower bound of the number of control steps to each goal.

    Args:
      table: the result of `farthest`.
      goals: positions relative to the start [m], x ahead and y to the left.
      radius: distance on the floor within which a goal is reached [m].

    Returns:
      The numbers of steps; a goal that is not reached within the table's steps has one more.
    """
    count = table.shape[1]
    angles = np.arange(count) * 2 * np.pi / count
    ahead = goals @ np.stack([np.cos(angles), np.sin(angles)]) - radius
    steps = np.full(len(goals), len(table))
    for t in range(len(table) - 1, -1, -1):
        steps[_within(ahead, table[t])] = t
    return steps


def _within(
    ahead: Float[np.ndarray, "n directions"], reach: Float[np.ndarray, " directions"]
) -> Bool[np.ndarray, " n"]:
    return np.all(ahead <= reach, axis=1)
