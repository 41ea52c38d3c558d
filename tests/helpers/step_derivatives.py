"""Derivatives of a MuJoCo model's step: of kernels, by XLA, and differences in float64."""

import jax
import mujoco
import numpy as np

from helpers.small_models import c_steps
from onekernel.kernel import inlined
from onekernel.mujoco import fuse_mjx

SOONEST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Options with which XLA compiles soonest for a CPU."""

DIFFERENCE = 1e-6
"""Of the finite differences, in the unit of an argument."""


STEADY = 3e-7
"""Differences of two steps that are farther apart, as a part of the largest, measure nothing."""

BOUNCE = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body pos="0 0 0.11">
      <joint name="lift" type="slide" axis="0 0 1" damping="0.1"/>
      <geom type="sphere" size="0.1" mass="1" condim="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="lift" gear="20" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
"""A ball that moves up and down over the floor: the smallest model with a contact."""


def converging(model):
    """Return a model whose solver ends as near to the optimum as float64 can be.

    It is Newton's: the optimum is that of conjugate gradients, which come less near.
    """
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    model.opt.tolerance, model.opt.ls_tolerance = 0.0, 1e-6
    return model


def touches(model, arguments):
    """Whether a constraint is active in each of the instances."""
    found = []
    for i in range(len(arguments["qpos"])):
        data = mujoco.MjData(model)
        for name in ("qpos", "qvel", "act", "ctrl"):
            getattr(data, name)[:] = arguments[name][i]
        mujoco.mj_forward(model, data)
        found.append(bool(np.any(data.efc_force)))
    return np.array(found)


def cases_of(model, count, *, forces=True, seed=0):
    """Return arguments of a step of several instances in float32, as a dictionary of arrays.

    Args:
      model: the model.
      count: number of instances.
      forces: whether forces are applied.
      seed: of the random numbers.
    """
    states, _, ctrl = c_steps(model, count, seed=seed)
    rng = np.random.default_rng(seed)
    arguments = {**states, "ctrl": ctrl}
    if model.nmocap:
        arguments["mocap_pos"] = np.tile(mujoco.MjData(model).mocap_pos, (count, 1, 1))
        arguments["mocap_quat"] = np.tile(mujoco.MjData(model).mocap_quat, (count, 1, 1))
    if forces:
        arguments["qfrc_applied"] = rng.normal(0.0, 0.1, (count, model.nv))
        arguments["xfrc_applied"] = rng.normal(0.0, 0.1, (count, model.nbody, 6))
    return {name: np.float32(x) for name, x in arguments.items()}


class Loss:
    """A weighted sum of all that a step changes, as a function of its arguments."""

    def __init__(self, step, *, by_xla=False):
        self.step, self.by_xla = step, by_xla

    def __call__(self, arguments):
        after = self.after(arguments)
        rng = np.random.default_rng(1)
        total = 0.0
        for name in ("qpos", "qvel", "act", "qacc_warmstart", "time"):
            x = getattr(after, name)
            # An acceleration is as large as the velocity it changes in a step.
            unit = self.step.mj_model.opt.timestep if name == "qacc_warmstart" else 1.0
            total += (unit * rng.normal(size=x.shape) * x).sum()
        return total

    def after(self, arguments):
        """Return the state after the step."""
        arguments = dict(arguments)
        forces = {x: arguments.pop(x) for x in ("qfrc_applied", "xfrc_applied") if x in arguments}
        ctrl = arguments.pop("ctrl")
        state = self.step.init().replace(**arguments)
        if not self.by_xla:
            return self.step(state, ctrl, **forces)
        with inlined():
            return self.step(state, ctrl, **forces)


def compiled(function):
    """Return a function of one instance for many, which XLA compiles soonest."""
    options = SOONEST if jax.default_backend() == "cpu" else None
    return jax.jit(jax.vmap(function), compiler_options=options)


def in_float64(model, n_substeps=1):
    """Return the loss of a step of MJX in float64; to be called under `jax.enable_x64`."""
    return Loss(fuse_mjx(model, n_substeps, on_unsupported="xla"), by_xla=True)


def directions(arguments, seed=2):
    """Return a random direction for each instance."""
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=x.shape) for name, x in arguments.items()}


def along(gradient, direction):
    """Return the derivative along a direction, of each instance."""
    parts = (gradient[x] * direction[x] for x in gradient)
    return np.sum([x.reshape(len(x), -1).sum(1) for x in parts], axis=0)


def differences(loss, arguments, direction):
    """Return the derivative along a direction by differences, and what two of them differ by.

    Args:
      loss: a function of one instance.
      arguments: those of several.
      direction: likewise.
    """
    run = compiled(loss)

    def quotient(step):
        ends = [
            run({name: x + sign * step * direction[name] for name, x in arguments.items()})
            for sign in (1, -1)
        ]
        return (ends[0] - ends[1]) / (2 * step)

    first, second, third = (quotient(k * DIFFERENCE) for k in (4, 2, 1))
    coarse, fine = (4 * second - first) / 3, (4 * third - second) / 3
    return fine, np.abs(fine - coarse)


def furthest(found, wanted):
    """Return the largest difference of two gradients, relative to the largest entry of all."""
    largest = max(np.abs(x).max() for x in wanted.values() if x.size)
    return max(np.abs(found[x] - wanted[x]).max() for x in wanted if wanted[x].size) / largest


def check(make_model, n_substeps=1, *, count=16, forces=True, kernel=True):
    """Check the gradients of a step at several states, some with active constraints.

    MJX's in float64 are those of differences, and a kernel's in float32 are these.

    Args:
      make_model: returns the model.
      n_substeps: number of physics steps.
      count: number of states.
      forces: whether forces are applied.
      kernel: whether to check a kernel's, too.
    """
    arguments = cases_of(make_model(), count, forces=forces)
    is_touching = touches(make_model(), arguments)
    assert is_touching.any()
    with jax.enable_x64(True):
        loss = in_float64(converging(make_model()), n_substeps)
        precise = {name: np.float64(x) for name, x in arguments.items()}
        wanted = jax.tree.map(np.asarray, compiled(jax.grad(loss))(precise))
        direction = directions(precise)
        found, change = differences(loss, precise, direction)
    ours = along(wanted, direction)
    largest = np.abs(ours).max()
    # Differences measure nothing where a constraint becomes active between their points.
    is_steady = change <= STEADY * largest
    assert is_steady.mean() >= 0.75
    assert (is_steady & is_touching).any()
    np.testing.assert_allclose(found[is_steady], ours[is_steady], rtol=0, atol=1e-6 * largest)
    if kernel:
        step = fuse_mjx(make_model(), n_substeps, on_unsupported="raise")
        assert furthest(gradients(Loss(step), arguments), wanted) < 1e-4


def gradients(loss, arguments):
    """Return the gradients of a loss at several states, as arrays of NumPy."""
    run = compiled(jax.grad(loss)) if loss.by_xla else jax.jit(jax.vmap(jax.grad(loss)))
    return jax.tree.map(np.asarray, run(arguments))
