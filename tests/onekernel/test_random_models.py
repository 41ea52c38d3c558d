"""Random MuJoCo models step as kernels as they do in MJX.

Two correct programs of one step differ by round-off, and a step may enlarge that: a contact solver
that stops an iteration earlier, a matrix that is nearly singular. How much it does so is measured,
in one way for all models: XLA also steps states each number of which is shaken by one unit in its
last place. A position, velocity or activation may differ from XLA's by `PLAIN` of the largest
number of all instances, or by as much as the shaken ones differ. Accelerations, of which the solver
starts, and sensors are nearer to the forces, in which the round-off is made: they may differ by
`FORCES` times as much.
"""

import jax
import numpy as np
import pytest

from helpers.random_models import random_model
from helpers.small_models import batch_of, by_mjx
from onekernel import default_backend, fuse
from onekernel.mujoco import fuse_mjx

pytestmark = pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")

QUICK = (1, 3, 5)
REGRESSIONS = ()
"""Seeds of models that a kernel once stepped wrongly."""

BATCH = 5  # models in one test of the slow suite
BATCHES = 42

PLAIN = 1e-6
FORCES = 10
INSTANCES, SHAKES = 16, 8
MOVES = ("qpos", "qvel", "act")


def shaken(rng, x):
    """Return numbers one unit in the last place above or below others."""
    return np.nextafter(x, np.where(rng.random(x.shape) < 0.5, -np.inf, np.inf).astype(x.dtype))


def with_shaken(rng, x):
    """Return the numbers of instances, followed by those of as many shaken ones as are asked."""
    return np.concatenate([x, *(shaken(rng, x) for _ in range(SHAKES))])


def distance(some, others):
    """Return the largest difference, relative to the largest number of all instances."""
    largest = np.abs(np.float64(others)).max(initial=1e-12)
    return np.abs(np.float64(some) - others).max(initial=0) / largest


def measured(seed):
    """Return by how much a step of a random model differs from XLA's.

    Returns:
      By the name of the field: the difference, what is allowed, and by how much the kernel and XLA
      differ from C MuJoCo in float64, which has no sensors here.
    """
    model, before, by_c, ctrl = random_model(seed, INSTANCES)
    step = fuse_mjx(model, on_unsupported="raise")
    rng = np.random.default_rng(seed)
    states = batch_of(step, {name: with_shaken(rng, x) for name, x in before.items()})
    ctrl = with_shaken(rng, ctrl)

    @fuse(on_unsupported="raise")
    def sense_and_step(state, ctrl):
        fields = vars(step(state, ctrl))
        if not model.nsensordata:
            return fields
        return fields | {"sensordata": step.forward(state, ctrl).sensordata}

    ours = jax.jit(jax.vmap(sense_and_step))(states, ctrl)
    theirs = by_mjx(step, states, ctrl)
    found = {}
    for name in ("qpos", "qvel", "act", "qacc_warmstart", "sensordata"):
        if not theirs.get(name, np.zeros(0)).size:
            continue
        plain, *others = np.split(theirs[name], SHAKES + 1)
        assert np.isfinite(plain).all()
        allowed = max(PLAIN, *(distance(x, plain) for x in others))
        allowed *= 1 if name in MOVES else FORCES
        mine = np.asarray(ours[name])[:INSTANCES]
        from_c = [distance(x, by_c[name]) for x in (mine, plain)] if name in by_c else []
        found[name] = distance(mine, plain), allowed, *from_c
    return found


def check(seed):
    """Check that a random model steps as in MJX, and return whether it does so to `PLAIN`."""
    found = measured(seed)
    for name, (difference, allowed, *from_c) in found.items():
        assert difference <= allowed, (
            f"seed {seed}: {name} differs by {difference:.1e}, more than {allowed:.1e};"
            f" the kernel and XLA differ from C MuJoCo by {from_c}"
        )
    return all(found[name][0] <= PLAIN for name in MOVES if name in found)


@pytest.mark.parametrize("seed", [*QUICK, *REGRESSIONS])
def test_a_random_model_moves_as_in_mjx(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(BATCHES))
def test_hundreds_of_random_models_move_as_in_mjx(batch):
    seeds = range(BATCH * batch, BATCH * (batch + 1))
    plain = [check(seed) for seed in seeds]
    # All but few models are so well conditioned that nothing needs to be measured.
    assert sum(plain) >= BATCH - 2
