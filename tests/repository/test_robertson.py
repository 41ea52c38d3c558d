"""The example of stiff equations: its method has its order, and its kernel finds SciPy's ends."""

import importlib.util
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from onekernel import default_backend, fuse


@pytest.fixture(scope="module")
def example(root):
    spec = importlib.util.spec_from_file_location("robertson", root / "examples" / "robertson.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def wide():
    with jax.enable_x64(True):
        yield


def test_the_method_is_of_order_three(example):
    rates = np.array([1.0, 2.0, 3.0])

    def end(count):
        step = lambda _, y: example.one_step(y, rates, jnp.asarray(4.0 / count))[0]  # noqa: E731
        return np.asarray(jax.lax.fori_loop(0, count, step, jnp.array([1.0, 0.0, 0.0])))

    ends = [end(count) for count in (160, 320, 640)]
    first, second = (np.abs(one - other).max() for one, other in itertools.pairwise(ends))
    assert 2**2.8 < first / second < 2**3.3


@pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")
def test_a_kernel_finds_the_ends_that_scipy_finds(example):
    rates, end = example.draw_rates(9), 1e4
    ends, counts = jax.jit(
        jax.vmap(fuse(lambda rates: example.solve(rates, end), on_unsupported="raise"))
    )(rates)
    assert ends.dtype == np.float64
    assert (counts < 1000).all()
    np.testing.assert_allclose(ends.sum(axis=1), 1, rtol=1e-12)
    np.testing.assert_allclose(ends[0], example.by_scipy(rates[0], end), rtol=2e-5)
    theirs, _ = jax.jit(jax.vmap(lambda rates: example.solve(rates, end)))(rates)
    # A step more or less makes as much as the tolerance.
    np.testing.assert_allclose(ends, theirs, rtol=1e-6)


@pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")
def test_it_tells_how_long_it_takes(example, capsys):
    assert example.main(["--instances", "4", "--compared", "1"]) == 0
    told = capsys.readouterr().out
    assert "one kernel" in told
    assert "from SciPy's" in told
