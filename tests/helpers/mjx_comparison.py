"""How far one step of a kernel may be from MJX's, which XLA computes: the criterion of all tests.

Two correct programs of one step differ by round-off, and a step may enlarge that: a contact solver
that stops an iteration earlier, a matrix that is nearly singular. How much it does so is measured,
in one way for all models: XLA also steps states each number of which is shaken by one unit in its
last place. Shaking does not move what the solver's cost decides: MJX takes a step only if float32
tells its cost from the one before. So where that is not enough, XLA computes the same step by two
more programs, for a batch of another size and for one instance after the other, and at last with
noise in every operation. A position, velocity or activation of the kernel's may differ from XLA's
by one of these:

- `PLAIN` of the largest number of all instances,
- as much as XLA's results differ among each other,
- where XLA is within `CONVERGED` of C MuJoCo in float64: anything, if the kernel is no farther from
  C than XLA or `PLAIN`.

Accelerations, from which the solver starts, and sensors are nearer to the forces, in which the
round-off is made. They may differ by `FORCES` times as much: 7 times was seen in 208 models.
"""

import dataclasses

import jax
import numpy as np

from helpers.small_models import batch_of, by_mjx
from onekernel import fuse
from onekernel.mujoco import fuse_mjx

PLAIN = 1e-6
CONVERGED = 1e-5
FORCES = 10
SHAKES = 32
NOISES = 8
LARGEST = 1e3
"""Of positions [m, rad] and velocities [m/s, rad/s] after a step."""
MOVES = ("qpos", "qvel", "act")
FIELDS = (*MOVES, "qacc_warmstart", "sensordata")


class MjxExplodesError(Exception):
    """Raised when a step that XLA computes is not finite, or far beyond what C MuJoCo makes of it:
    kernels take numbers for finite, and there is nothing to compare with."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """How far a field of the kernel's is from XLA's, relative to its largest number."""

    name: str
    found: float
    allowed: float
    from_c: tuple[float, float] | None
    """How far the kernel and XLA are from C MuJoCo in float64; None: it was not asked."""

    @property
    def is_round_off(self):
        """Whether the criterion allows the difference."""
        if self.found <= self.allowed or self.from_c is None:
            return self.found <= self.allowed
        kernel, xla = self.from_c
        return xla < CONVERGED and kernel <= max(PLAIN, xla)

    def __str__(self):
        return (
            f"{self.name} differs by {self.found:.1e} of at most {self.allowed:.1e}; the kernel"
            f" and XLA differ from C MuJoCo by {self.from_c}"
        )


def differences(model, before, by_c, ctrl):
    """Return how far one step of a kernel is from MJX's, for each field that the model has.

    Args:
      model: the model.
      before: fields of the states of several instances, as `c_steps` returns them.
      by_c: those that C MuJoCo makes of them.
      ctrl: the controls.

    Raises:
      MjxExplodesError: what XLA computes cannot be compared with.
    """
    step = fuse_mjx(model, on_unsupported="raise")
    rng, count = np.random.default_rng(0), len(ctrl)
    states = batch_of(step, {name: _with_shaken(rng, x) for name, x in before.items()})
    controls = _with_shaken(rng, ctrl)
    theirs = by_mjx(step, states, controls)
    fields = [name for name in FIELDS if name in theirs and theirs[name].size]
    plain, *others = (
        {name: np.split(theirs[name], SHAKES + 1)[i] for name in fields} for i in range(SHAKES + 1)
    )
    largest = max(np.abs(plain[name]).max() for name in MOVES if name in fields)
    if not largest < LARGEST:
        raise MjxExplodesError(f"MJX's own step ends at {largest:.1e}")
    ours = jax.tree.map(lambda x: np.asarray(x)[:count], _by_kernel(step, states, controls))

    def compare():
        return [_difference(name, ours, plain, others, by_c) for name in fields]

    if not all(x.is_round_off for x in compare()):
        first = batch_of(step, before)
        others += [by_mjx(step, first, ctrl), by_mjx(step, first, ctrl, batched=False)]
    if not all(x.is_round_off for x in compare()):
        seeds = rng.integers(1, 2**32, (NOISES, count), np.uint32)
        repeated = jax.tree.map(lambda x: np.concatenate([x] * NOISES), (before, ctrl))
        made = by_mjx(step, batch_of(step, repeated[0]), repeated[1], noise=seeds.ravel())
        parts = {name: np.split(made[name], NOISES) for name in fields}
        others += [{name: one[i] for name, one in parts.items()} for i in range(NOISES)]
    return compare()


def assert_moves_as_in_mjx(model, before, by_c, ctrl):
    """Check one step of a kernel by the criterion; the arguments are those of `differences`."""
    for difference in differences(model, before, by_c, ctrl):
        assert difference.is_round_off, str(difference)


def _by_kernel(step, states, ctrl):
    """Return the same as `by_mjx`, computed by one kernel."""

    @fuse(on_unsupported="raise")
    def sense_and_step(state, ctrl):
        fields = vars(step(state, ctrl))
        if not step.mj_model.nsensordata:
            return fields
        return fields | {"sensordata": step.forward(state, ctrl).sensordata}

    return jax.jit(jax.vmap(sense_and_step))(states, ctrl)


def _difference(name, ours, plain, others, by_c):
    results = np.stack([np.float64(x[name]) for x in (plain, *others)])
    largest = np.abs(results[0]).max(initial=1e-12)
    allowed = max(PLAIN, float(np.ptp(results, axis=0).max() / largest))
    allowed *= 1 if name in MOVES else FORCES
    from_c = None
    if name in by_c:
        from_c = _distance(ours[name], by_c[name]), _distance(plain[name], by_c[name])
    return Difference(name, _distance(ours[name], plain[name]), allowed, from_c)


def _with_shaken(rng, x):
    """Return the numbers of instances, followed by those of as many shaken ones as are asked."""
    up = [rng.random(x.shape) < 0.5 for _ in range(SHAKES)]
    ends = [np.where(one, np.inf, -np.inf).astype(x.dtype) for one in up]
    return np.concatenate([x, *(np.nextafter(x, end) for end in ends)])


def _distance(some, others):
    """Return the largest difference, relative to the largest number of all instances."""
    largest = np.abs(np.float64(others)).max(initial=1e-12)
    return float(np.abs(np.float64(some) - others).max(initial=0) / largest)
