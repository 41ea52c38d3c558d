"""Time compiled programs.

`TimedProgram` compiles a step, warms it up and times it. Every call continues from the state that
the last one returned, and every step adds all its outputs to a checksum, so that the compiler
can remove no part of it.
"""

import math
import os
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt32

from jetbot_mjx.config import RobotConfig
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.errors import UserError

WARM_UP_CALLS = 3  # GPUs record their command graphs in the second call
REPEAT_SECONDS = 0.25  # [s] a shorter repeat would time the dispatch
_RADIUS = RobotConfig().wheel_radius
Z_RANGE = (0.5 * _RADIUS, 1.5 * _RADIUS)  # [m] axle of a robot on its wheels


class Row(NamedTuple):
    """A `Row` holds one rate at one number of environments."""

    rate: str
    num_envs: int
    env_steps_per_second: float
    """Median of the repeats, summed over the environments."""
    physics_steps_per_second: float
    """`env_steps_per_second` times the physics steps in an environment step."""
    microseconds_per_step: float
    """Median time in which all environments together make one step [µs]."""
    compile_seconds: float
    """Time of tracing, lowering and compiling [s]; it is not part of the rates."""
    repeats: list[float]
    """`env_steps_per_second` of each repeat."""
    steps_per_repeat: int
    """Steps that each environment makes in one repeat."""
    episodes_per_env_step: float | None = None
    """Share of the steps that ended an episode; None: not counted."""
    nonfinite_envs: int | None = None
    """Non-finite states that were reset, warm-up included; None: not counted."""
    peak_device_bytes: int | None = None
    """Peak memory of one device so far in this process; None: the device does not report it."""


class Tally(NamedTuple):
    """A `Tally` holds the sums to which every step adds, one value for each environment."""

    checksum: Float[Array, " n"]
    """Sum of all outputs, so that the compiler cannot remove any part of a step."""
    episodes: Float[Array, " n"]
    nonfinite: Float[Array, " n"]


class Carry(NamedTuple):
    """A `Carry` holds what one step passes to the next: a state, a key and the sums."""

    state: Any
    key: UInt32[Array, "2"]
    tally: Tally


Step = Callable[[Carry], Carry]


class TimedProgram:
    """A compiled and warmed-up program, timed once by every call of `repeat`.

    The output of each call is the input of the next, so that the robots continue to drive.
    """

    def __init__(
        self,
        rate: str,
        step: Step,
        first: PyTree,
        *,
        n_substeps: int,
        calls: int,
        length: int = 1,
        check: Callable[[str, Carry], None] | None = None,
    ) -> None:
        """Compile a scan over `step` into one program and warm it up.

        Args:
          rate: The name of the rate.
          step: A step of all environments; it makes `length` environment steps.
          first: The initial state; the first axis of its leaves is that of the environments.
          n_substeps: The number of physics steps in an environment step.
          calls: The number of calls of `step` in the program.
          length: The number of environment steps in one call of `step`.
          check: Raises an error for an invalid final state; None: checks that the robots stand.
        """
        self.rate = rate
        self.num_envs = jax.tree.leaves(first)[0].shape[0]
        zeros = jnp.zeros(self.num_envs)
        self._carry = Carry(first, jax.random.PRNGKey(1), Tally(zeros, zeros, zeros))
        self._check = check or _check_robots
        self._n_substeps = n_substeps
        self._steps_per_call = calls * length
        self._steps = 0

        def run(carry: Carry) -> Carry:
            return jax.lax.scan(lambda carry, _: (step(carry), None), carry, length=calls)[0]

        start = time.perf_counter()
        self._program = jax.jit(run).lower(self._carry).compile()
        self.compile_seconds = time.perf_counter() - start
        self._calls = warm_up(self._time_calls)

    def repeat(self) -> float:
        """Return the environment steps per second of one repeat, summed over the environments."""
        seconds = self._time_calls(self._calls)
        return self.num_envs * self._calls * self._steps_per_call / seconds

    def row(self, repeats: list[float]) -> Row:
        """Return the measured row.

        Args:
          repeats: The values that `repeat` returned.

        Raises:
          UserError: A state is not finite, or a robot has left the floor.
        """
        self._check(self.rate, self._carry)
        row = make_row(
            self.rate,
            self._n_substeps,
            self.num_envs,
            self.compile_seconds,
            repeats,
            self._calls * self._steps_per_call,
        )
        tally = self._carry.tally
        return row._replace(
            episodes_per_env_step=float(tally.episodes.sum()) / (self.num_envs * self._steps),
            nonfinite_envs=int(tally.nonfinite.sum()),
        )

    def _time_calls(self, calls: int) -> float:
        """Call the program, each time on its last output, and return the time [s]."""
        start = time.perf_counter()
        for _ in range(calls):
            self._carry = self._program(self._carry)
        jax.block_until_ready(self._carry)
        self._steps += calls * self._steps_per_call
        return time.perf_counter() - start


def warm_up(time_calls: Callable[[int], float], at_least: int = 1) -> int:
    """Warm up and return how many calls fill a repeat of `REPEAT_SECONDS`.

    Args:
      time_calls: Makes the given number of calls and returns their time [s].
      at_least: The smallest number of calls, also in the warm-up.
    """
    seconds = math.inf
    for _ in range(WARM_UP_CALLS):
        seconds = time_calls(at_least) / at_least
    return max(at_least, math.ceil(REPEAT_SECONDS / seconds))


def make_row(
    rate: str,
    n_substeps: int,
    num_envs: int,
    compile_seconds: float,
    repeats: list[float],
    steps_per_repeat: int,
) -> Row:
    """Return a row computed from its repeats; `Row` describes the arguments."""
    median = statistics.median(repeats)
    return Row(
        rate=rate,
        num_envs=num_envs,
        env_steps_per_second=median,
        physics_steps_per_second=median * n_substeps,
        microseconds_per_step=1e6 * num_envs / median,
        compile_seconds=compile_seconds,
        repeats=repeats,
        steps_per_repeat=steps_per_repeat,
        peak_device_bytes=_peak_device_bytes(),
    )


def _peak_device_bytes() -> int | None:
    stats = [device.memory_stats() or {} for device in jax.local_devices()]
    return max((one.get("peak_bytes_in_use") or 0 for one in stats), default=0) or None


def _check_robots(rate: str, carry: Carry) -> None:
    """Raise an error unless all states are finite and all robots stand on their wheels.

    Steps of non-finite states can be faster, so that their rate would be misleading.
    """
    state = carry.state
    physics = state if isinstance(state, PhysicsState) else state.pipeline_state
    z = np.asarray(physics.qpos[:, 2])
    valid = (z > Z_RANGE[0]) & (z < Z_RANGE[1])
    for leaf in jax.tree.leaves((physics, carry.tally)):
        valid &= np.isfinite(np.asarray(leaf).reshape(z.size, -1)).all(axis=1)
    if not valid.all():
        raise UserError(
            f"{rate} at {z.size} environments: {z.size - valid.sum()} states are not finite, or"
            " their robots not on the floor, so that the rate means nothing"
        )


def available_cores() -> int:
    """Return the number of CPU cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def env_keys(num_envs: int) -> UInt32[Array, "n 2"]:
    """Return one key for the first reset of each environment."""
    return jax.random.split(jax.random.PRNGKey(0), num_envs)


def random_actions(
    key: UInt32[Array, "2"], num_envs: int, size: int = 2
) -> tuple[UInt32[Array, "2"], Float[Array, "n a"]]:
    """Return the next key, and actions of the given size that are uniform in [-1, 1]."""
    key, action_key = jax.random.split(key)
    return key, jax.random.uniform(action_key, (num_envs, size), minval=-1.0, maxval=1.0)


def sum_per_env(tree: PyTree) -> Float[Array, " n"]:
    """Return for each environment the sum over all leaves of a tree."""
    leaves = [leaf.reshape(leaf.shape[0], -1) for leaf in jax.tree.leaves(tree)]
    zeros = jnp.zeros(leaves[0].shape[0])
    return sum((leaf.astype(jnp.float32).sum(axis=1) for leaf in leaves), zeros)


def add_tallies(total: Tally, step: Tally) -> Tally:
    """Return the sums after one more step."""
    return jax.tree.map(jnp.add, total, step)
