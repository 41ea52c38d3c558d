"""How far one step of a kernel may be from MJX's, which XLA computes: the criterion of all tests.

Two correct programs of one step differ by round-off, and a step may enlarge that: a contact solver
that stops an iteration earlier, a matrix that is nearly singular. How much it does so is measured,
in one way for all models: XLA also steps states each number of which is shaken by one unit in its
last place. A position, velocity or activation may differ from XLA's by `PLAIN` of the largest
number of all instances, or by as much as the shaken ones differ. Accelerations, from which the
solver starts, and sensors are nearer to the forces, in which the round-off is made: they may differ
by `FORCES` times as much.
"""

import dataclasses

import jax
import numpy as np

from helpers.small_models import batch_of, by_mjx
from onekernel import fuse
from onekernel.mujoco import fuse_mjx

PLAIN = 1e-6
FORCES = 10
SHAKES = 8
MOVES = ("qpos", "qvel", "act")
FIELDS = (*MOVES, "qacc_warmstart", "sensordata")


@dataclasses.dataclass(frozen=True)
class Difference:
    """How far a field of the kernel's is from XLA's, relative to its largest number."""

    name: str
    found: float
    allowed: float
    from_c: tuple[float, float] | None
    """How far the kernel and XLA are from C MuJoCo in float64; None: it was not asked."""

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
    """
    step = fuse_mjx(model, on_unsupported="raise")
    rng, count = np.random.default_rng(0), len(ctrl)
    states = batch_of(step, {name: _with_shaken(rng, x) for name, x in before.items()})
    ctrl = _with_shaken(rng, ctrl)

    @fuse(on_unsupported="raise")
    def sense_and_step(state, ctrl):
        fields = vars(step(state, ctrl))
        if not model.nsensordata:
            return fields
        return fields | {"sensordata": step.forward(state, ctrl).sensordata}

    ours = jax.jit(jax.vmap(sense_and_step))(states, ctrl)
    theirs = by_mjx(step, states, ctrl)
    found = []
    for name in FIELDS:
        if name not in theirs or not theirs[name].size:
            continue
        plain, *others = np.split(theirs[name], SHAKES + 1)
        assert np.isfinite(plain).all(), name
        mine = np.asarray(ours[name])[:count]
        allowed = max(PLAIN, *(_distance(x, plain) for x in others))
        allowed *= 1 if name in MOVES else FORCES
        from_c = tuple(_distance(x, by_c[name]) for x in (mine, plain)) if name in by_c else None
        found.append(Difference(name, _distance(mine, plain), allowed, from_c))
    return found


def assert_moves_as_in_mjx(model, before, by_c, ctrl):
    """Check one step of a kernel by the criterion; the arguments are those of `differences`."""
    for difference in differences(model, before, by_c, ctrl):
        assert difference.found <= difference.allowed, str(difference)


def _with_shaken(rng, x):
    """Return the numbers of instances, followed by those of as many shaken ones as are asked."""
    up = [rng.random(x.shape) < 0.5 for _ in range(SHAKES)]
    ends = [np.where(one, np.inf, -np.inf).astype(x.dtype) for one in up]
    return np.concatenate([x, *(np.nextafter(x, end) for end in ends)])


def _distance(some, others):
    """Return the largest difference, relative to the largest number of all instances."""
    largest = np.abs(np.float64(others)).max(initial=1e-12)
    return float(np.abs(np.float64(some) - others).max(initial=0) / largest)
