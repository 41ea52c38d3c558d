"""What JAX differentiates of a MuJoCo model's step is kernels, with the derivatives of MJX."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.further import slow_unless
from helpers.small_kernels import launches
from helpers.small_models import model_of
from helpers.step_derivatives import BOUNCE, Loss, cases_of, compiled, furthest, gradients, touches
from onekernel import KernelError, UnsupportedError, cpu, fuse
from onekernel.lower import jaxpr
from onekernel.mujoco import fuse_mjx

pytestmark = pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels here")

POINTS = np.array([[-0.02, -0.3, 0.2], [0.05, 0.1, -0.4], [-0.011, 0.0, 0.9]], np.float32)
"""Position, velocity and control of three balls, two of which are on the floor."""


@pytest.fixture(autouse=True)
def without_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.fixture(scope="module")
def ball():
    return fuse_mjx(model_of(BOUNCE), 2, on_unsupported="raise")


@pytest.fixture(scope="module")
def arguments():
    return cases_of(model_of(BOUNCE), 16)


def of_vector(step, x, *, by_xla=False):
    """The position and velocity after a step from those before it, and a control."""
    arguments = {"qpos": x[:1], "qvel": x[1:2], "ctrl": x[2:]}
    after = Loss(step, by_xla=by_xla).after(arguments)
    return jnp.concatenate([after.qpos, after.qvel])


def several(step, x, *, by_xla=False):
    """The position and velocity after each of four steps."""

    def each(state, ctrl):
        state = of_vector(step, jnp.concatenate([state, ctrl]), by_xla=by_xla)
        return state, state

    return jax.lax.scan(each, x[:2], x[2:, None] * jnp.ones((4, 1)))[1]


def test_a_gradient_is_that_of_mjx_by_xla(ball, arguments):
    assert 0 < touches(ball.mj_model, arguments).sum() < 16
    wanted = gradients(Loss(ball, by_xla=True), arguments)
    assert {"qpos", "qvel", "ctrl", "qfrc_applied", "xfrc_applied"} <= {
        name for name, x in wanted.items() if np.abs(x).max(initial=0) > 1e-3
    }
    assert furthest(gradients(Loss(ball), arguments), wanted) < 1e-5


def along(function, x):
    return jax.jvp(function, (x,), (jnp.array([1.0, -2.0, 0.5]),))[1]


TRANSFORMED = {
    "grad": lambda f: jax.grad(lambda x: (f(x) ** 2).sum()),
    "jvp": lambda f: functools.partial(along, f),
    "jacfwd": jax.jacfwd,
    "jacrev": jax.jacrev,
}


@pytest.mark.parametrize(
    ("name", "function"),
    slow_unless(
        lambda name, function: function == several and name in ("grad", "jvp"),
        [(name, function) for name in TRANSFORMED for function in (of_vector, several)],
    ),
)
def test_what_jax_differentiates_is_two_kernels(ball, name, function):
    ours, theirs = (
        TRANSFORMED[name](functools.partial(function, ball, by_xla=by_xla))
        for by_xla in (False, True)
    )
    ours = jax.vmap(ours)
    assert launches(ours, POINTS) == 2
    wanted = np.asarray(compiled(theirs)(POINTS))
    assert np.abs(wanted).max() > 0.5
    np.testing.assert_allclose(jax.jit(ours)(POINTS), wanted, atol=1e-5 * np.abs(wanted).max())


def environment(step):
    """A step with a reward, as a function that is one kernel."""

    @fuse(on_unsupported="raise")
    def env(x):
        after = of_vector(step, x)
        return after, jnp.exp(-(after[0] ** 2)) - 0.1 * x[2] ** 2

    return env


def test_a_function_around_a_step_is_two_kernels_as_well(ball):
    env = environment(ball)
    gradient = jax.vmap(jax.grad(lambda x: env(x)[1] + env(x)[0].sum()))

    def by_xla(x):
        after = of_vector(ball, x, by_xla=True)
        return after.sum() + jnp.exp(-(after[0] ** 2)) - 0.1 * x[2] ** 2

    wanted = compiled(jax.grad(by_xla))(POINTS)
    found = jax.jit(gradient)(POINTS)
    np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())
    one = jax.vmap(jax.grad(lambda x: env(x)[1]))
    assert launches(one, POINTS) == 2


def test_a_number_from_a_function_around_it_is_to_be_an_argument(ball):
    def loss(x, target):
        env = fuse(lambda x: ((of_vector(ball, x) - target) ** 2).sum(), on_unsupported="raise")
        return env(x)

    with pytest.raises(KernelError, match="one kernel cannot be differentiated"):
        jax.jit(jax.grad(loss)).trace(POINTS[0], jnp.zeros(2))


def test_a_derivative_too_large_for_one_kernel_is_computed_by_xla_with_one_line(ball, monkeypatch):
    monkeypatch.setattr(jaxpr, "MAX_PROGRAM_OPERATIONS", 3)
    step = fuse_mjx(ball.mj_model, 2)
    gradient = compiled(jax.grad(lambda x: (of_vector(step, x) ** 2).sum()))
    said = r"XLA compiles the derivative of mjx\.step, which is slower: .* more than 3"
    with pytest.warns(UserWarning, match=said) as warned:
        found = gradient(POINTS)
    assert len(warned) == 1
    monkeypatch.undo()
    wanted = jax.jit(jax.vmap(jax.grad(lambda x: (of_vector(ball, x) ** 2).sum())))(POINTS)
    np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())


def test_a_derivative_too_large_for_one_kernel_is_refused_if_you_want(ball, monkeypatch):
    step = fuse_mjx(ball.mj_model, 2, on_unsupported="raise")
    assert step.kernel is not None
    monkeypatch.setattr(jaxpr, "MAX_PROGRAM_OPERATIONS", 3)
    with pytest.raises(UnsupportedError, match="more than 3"):
        jax.grad(lambda x: of_vector(step, x).sum())(POINTS[0])


@pytest.mark.slow
def test_debug_nans_finds_a_gradient_that_is_not_finite(ball):
    def gradient(x):
        return jax.grad(lambda x: of_vector(ball, x).sum())(x)

    wanted = gradient(POINTS[0])
    with jax.debug_nans(True):
        np.testing.assert_allclose(gradient(POINTS[0]), wanted, rtol=1e-5)
        with pytest.raises(FloatingPointError, match="nan"):
            gradient(POINTS[0] * np.nan)
