"""The example of parameter estimation: its gradient is right, and its estimates are near."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from onekernel import default_backend, fuse


@pytest.fixture(scope="module")
def example(root):
    path = root / "examples" / "lotka_volterra.py"
    spec = importlib.util.spec_from_file_location("lotka_volterra", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_cycle_keeps_what_lotka_and_volterra_keep(example):
    logarithms = jnp.log(jnp.array([1.1, 0.9, 0.7, 0.8]))
    x, y = np.asarray(example.observe(logarithms)).T
    kept = 0.7 * x - 0.8 * np.log(x) + 0.9 * y - 1.1 * np.log(y)
    np.testing.assert_allclose(kept, kept[0], rtol=1e-5)
    assert x.max() > 1.5 * x.min()


@pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")
def test_a_kernel_computes_the_gradient_and_the_estimates_are_near(example):
    true, observed = jax.vmap(example.draw)(jax.random.split(jax.random.key(3), 64))
    gradient = jax.value_and_grad(example.loss)
    ours = jax.jit(jax.vmap(fuse(gradient, on_unsupported="raise")))(true, observed)
    theirs = jax.jit(jax.vmap(gradient))(true, observed)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-3)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-2, atol=2e-5)
    found, losses = jax.jit(example.estimate)(observed)
    # The noise of 3 % is what remains.
    assert np.median(losses) < 0.03**2
    assert np.median(np.abs(np.exp(found - true) - 1)) < 0.02


@pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")
def test_it_tells_how_long_it_takes(example, capsys):
    assert example.main(["--instances", "4", "--steps", "3"]) == 0
    one, other = capsys.readouterr().out.splitlines()
    assert one.startswith("one kernel")
    assert one.partition("median")[2] == other.partition("median")[2]
