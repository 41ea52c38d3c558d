"""The clock that programs are held to, and what it says of one.

Of the robots nothing is known here but that they must still stand at the end.
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

from jetbot_mjx.envs.robot_model import WHEEL_RADIUS
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.errors import UserError

WARM_UP_CALLS = 3  # GPUs record their command graphs in the second call
REPEAT_SECONDS = 0.25  # [s] a shorter repeat would time the dispatch
Z_RANGE = (0.5 * WHEEL_RADIUS, 1.5 * WHEEL_RADIUS)  # [m] axle of a robot on its wheels


class Row(NamedTuple):
    """One rate at one number of environments."""

    rate: str
    num_envs: int
    env_steps_per_second: float
    """Median of the repeats, summed over the environments."""
    physics_steps_per_second: float
    """The same, times the physics steps in an environment step."""
    microseconds_per_step: float
    """Median time in which all environments together make one step [µs]."""
    compile_seconds: float
    """Tracing, lowering and compiling [s]; no part of the rates."""
    repeats: list[float]
    """`env_steps_per_second` of each repeat."""
    steps_per_repeat: int
    """Steps that each environment made in one repeat."""
    episodes_per_env_step: float | None = None
    """Share of the steps that ended an episode; None: not counted."""
    nonfinite_envs: int | None = None
    """Worlds that blew up and were reset, warm-up included; None: not counted."""
    peak_device_bytes: int | None = None
    """Most memory that one device had in use so far in this process; None: it does not tell."""


class Tally(NamedTuple):
    """What every step adds to, so that the compiler can leave no part of a step out."""

    checksum: Float[Array, " n"]
    episodes: Float[Array, " n"]
    nonfinite: Float[Array, " n"]


class Carry(NamedTuple):
    """What one call hands to the next: a state, a key, and the sums."""

    state: Any
    key: UInt32[Array, "2"]
    tally: Tally


Step = Callable[[Carry], Carry]


class Timed:
    """A program that is compiled and warm, and is timed once for every call of `repeat`.

    What it returns goes into its next call: robots drive on.
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
        """Compiles `calls` of a step of `length` environment steps into one program.

        Args:
          rate: its name.
          step: of all environments.
          first: the state to begin with; its leaves begin with the axis of the environments.
          n_substeps: physics steps in an environment step.
          calls: of `step` in the program.
          length: environment steps in one of them.
          check: refuses a state at the end that means nothing; None: of the robots.
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

        begun = time.perf_counter()
        self._program = jax.jit(run).lower(self._carry).compile()
        self.compile_seconds = time.perf_counter() - begun
        seconds = math.inf
        for _ in range(WARM_UP_CALLS):
            seconds = self._clocked(1)
        self._calls = max(1, math.ceil(REPEAT_SECONDS / seconds))

    def repeat(self) -> float:
        """Environment steps per second over one repeat, summed over the environments."""
        seconds = self._clocked(self._calls)
        return self.num_envs * self._calls * self._steps_per_call / seconds

    def row(self, repeats: list[float]) -> Row:
        """What was measured.

        Args:
          repeats: what `repeat` returned.

        Raises:
          UserError: worlds blew up, so that the rates mean nothing.
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

    def _clocked(self, calls: int) -> float:
        """Calls the program, each time on what it last returned, and takes the time [s]."""
        begun = time.perf_counter()
        for _ in range(calls):
            self._carry = self._program(self._carry)
        jax.block_until_ready(self._carry)
        self._steps += calls * self._steps_per_call
        return time.perf_counter() - begun


def make_row(
    rate: str,
    n_substeps: int,
    num_envs: int,
    compile_seconds: float,
    repeats: list[float],
    steps_per_repeat: int,
) -> Row:
    """A row from its repeats, as `Row` describes them; what else it may hold is not counted."""
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
    """Refuses the rate of robots that no longer exist: what is not a number steps fast."""
    state = carry.state
    physics = state if isinstance(state, PhysicsState) else state.pipeline_state
    z = np.asarray(physics.qpos[:, 2])
    sound = (z > Z_RANGE[0]) & (z < Z_RANGE[1])
    for leaf in jax.tree.leaves((physics, carry.tally)):
        sound &= np.isfinite(np.asarray(leaf).reshape(z.size, -1)).all(axis=1)
    if not sound.all():
        raise UserError(
            f"{rate} at {z.size} environments: {z.size - sound.sum()} worlds are not finite, or"
            " their robots not on the floor, so that the rate means nothing"
        )


def available_cores() -> int:
    """CPU cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def env_keys(num_envs: int) -> UInt32[Array, "n 2"]:
    """Keys for the first reset of every environment."""
    return jax.random.split(jax.random.PRNGKey(0), num_envs)


def random_actions(
    key: UInt32[Array, "2"], num_envs: int, size: int = 2
) -> tuple[UInt32[Array, "2"], Float[Array, "n a"]]:
    """Actions of this size, uniform in [-1, 1], and the key for the next ones."""
    key, action_key = jax.random.split(key)
    return key, jax.random.uniform(action_key, (num_envs, size), minval=-1.0, maxval=1.0)


def sums(tree: PyTree) -> Float[Array, " n"]:
    """One sum for each environment over everything in a tree."""
    leaves = [leaf.reshape(leaf.shape[0], -1) for leaf in jax.tree.leaves(tree)]
    zeros = jnp.zeros(leaves[0].shape[0])
    return sum((leaf.astype(jnp.float32).sum(axis=1) for leaf in leaves), zeros)


def add(total: Tally, step: Tally) -> Tally:
    """The sums, one step further."""
    return jax.tree.map(jnp.add, total, step)
