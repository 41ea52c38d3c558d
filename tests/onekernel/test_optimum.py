"""MJX's step has the derivatives of its solver's optimum."""

import functools
import threading
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import solver

from benchmarks.throughput.fuse import GYMNASIUM, PACKAGES
from helpers.small_models import BUTTON, CART_POLE, HOPPER, model_of
from helpers.step_derivatives import (
    BOUNCE,
    check,
    compiled,
    converging,
    in_float64,
)
from onekernel.optimum import SOLUTION, differentiable_solver

OPTION = 'timestep="0.004"'
RUBS = CART_POLE.replace('damping="0.02"', 'damping="0.02" frictionloss="0.05"')
"""A cart whose pole has dry friction."""


def hopper(options):
    return HOPPER.replace(OPTION, f"{OPTION} {options}")


MODELS = {
    "a limit and an activation": (CART_POLE, "Euler", 3),
    "dry friction": (RUBS, "implicitfast", 1),
    "a pyramid": (HOPPER, "Euler", 3),
    "a pyramid, Runge-Kutta": (HOPPER, "RK4", 1),
    "conjugate gradients": (hopper('solver="CG"'), "Euler", 1),
    "an elliptic cone": (hopper('cone="elliptic"'), "implicitfast", 3),
    "an elliptic cone, conjugate gradients": (hopper('cone="elliptic" solver="CG"'), "Euler", 1),
    "a free body at a mocap body": (BUTTON, "Euler", 1),
}


def test_a_ball_on_the_floor_has_the_derivatives_of_differences():
    check(functools.partial(model_of, BOUNCE), 2, kernel=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_a_small_model_has_the_derivatives_of_differences(name):
    xml, integrator, n_substeps = MODELS[name]
    check(functools.partial(model_of, xml, integrator), n_substeps)


def of_gymnasium(name):
    folder = Path(gymnasium.__file__).parents[1]
    model = mujoco.MjModel.from_xml_path(str(folder / PACKAGES[name]))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    return model


@pytest.mark.slow
@pytest.mark.parametrize("name", GYMNASIUM)
def test_a_model_of_gymnasium_has_the_derivatives_of_differences(name):
    # The gradient of an ant has more operations than one kernel may have.
    check(functools.partial(of_gymnasium, name), forces=False, kernel=name != "ant")


@pytest.mark.slow
def test_second_derivatives_are_those_of_differences():
    with jax.enable_x64(True):
        loss = in_float64(converging(model_of(BOUNCE)))

        def of_vector(x):
            return loss({"qpos": x[:1], "qvel": x[1:], "ctrl": jnp.zeros(1)})

        # Contacts of 0.2 to 0.8 mm: the deeper, the stiffer, up to 1 mm. The last ball flies.
        depths = np.array([0.2e-3, 0.4e-3, 0.6e-3, 0.8e-3, -1e-3])
        points = jnp.stack([-0.01 - depths, np.linspace(-0.1, -0.2, 5)], axis=1)
        found = np.asarray(compiled(jax.hessian(of_vector))(points))
        gradient = compiled(jax.grad(of_vector))
        moves = 2e-7 * np.eye(2)
        wanted = [(gradient(points + x) - gradient(points - x)) / 4e-7 for x in moves]
    wanted = np.stack(wanted, axis=-1)
    largest = np.abs(wanted).max(axis=(1, 2))
    assert (largest[:4] > 100).all()
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6 * largest.max())


def test_another_thread_traces_the_solver_of_mjx():
    model = mjx.put_model(model_of(BOUNCE))
    data = mjx.make_data(model)
    texts = []

    def trace():
        texts.append(str(jax.make_jaxpr(lambda: mjx.forward(model, data).qacc)()))

    trace()
    with differentiable_solver():
        trace()
        thread = threading.Thread(target=trace)
        thread.start()
        thread.join()
    trace()
    plain, ours, of_thread, after = [SOLUTION in x for x in texts]
    assert (plain, ours, of_thread, after) == (False, True, False, False)
    assert solver.solve.__module__ == solver.__name__
