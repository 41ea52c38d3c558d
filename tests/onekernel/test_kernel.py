"""One kernel for all robots: its batches, its types, its platforms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.large_arrays import remembered
from helpers.small_kernels import launches, made
from onekernel import KernelError, cpu, fuse, gpu

if all(backend.obstacle() for backend in (cpu, gpu)):
    pytest.skip("there is no kernel here", allow_module_level=True)


@pytest.fixture(scope="module")
def step():
    return made()


def test_one_robot_needs_no_batch(step):
    result = step({"x": jnp.arange(3.0), "n": jnp.zeros(())}, jnp.float32(3))
    np.testing.assert_array_equal(result["x"], [0, 9, 18])
    assert result["n"] == 2


def test_a_batch_is_one_launch_and_what_is_common_to_all_is_given_to_each(step):
    states = {"x": jnp.ones((5, 3)), "n": jnp.arange(5.0)}
    batch = jax.vmap(step, in_axes=(0, None))
    result = jax.jit(batch)(states, jnp.float32(2))
    np.testing.assert_array_equal(result["x"], np.full((5, 3), 4))
    np.testing.assert_array_equal(result["n"], np.arange(5) + 2)
    assert launches(batch, states, jnp.float32(2)) == 1


def test_a_batch_of_batches_along_any_axes_is_one_launch(step):
    states = {"x": jnp.ones((5, 3, 2)), "n": jnp.zeros(5)}
    held = jnp.arange(10.0).reshape(2, 5)
    batch = jax.vmap(jax.vmap(step), in_axes=({"x": 2, "n": None}, 0))
    result = batch(states, held)
    np.testing.assert_array_equal(result["x"][..., 1], np.arange(10).reshape(2, 5) ** 2)
    assert result["n"].shape == (2, 5)
    assert launches(batch, states, held) == 1


@pytest.mark.parametrize("robots", [0, 1, 17])
def test_any_number_of_robots_will_do(step, robots):
    states = {"x": jnp.ones((robots, 3)), "n": jnp.zeros(robots)}
    result = jax.vmap(step)(states, jnp.full(robots, 2.0))
    np.testing.assert_array_equal(result["x"], np.full((robots, 3), 4))


def test_it_can_be_looped_over(step):
    def body(states, _):
        return jax.vmap(step, in_axes=(0, None))(states, jnp.float32(2)), states["n"][0]

    states = {"x": jnp.ones((5, 3)), "n": jnp.zeros(5)}
    last, counts = jax.jit(lambda s: jax.lax.scan(body, s, length=3))(states)
    np.testing.assert_array_equal(counts, [0, 2, 4])
    np.testing.assert_array_equal(last["x"], np.full((5, 3), 64))


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16, jnp.int32])
def test_other_types_are_refused(step, dtype):
    state = {"x": jnp.ones(3), "n": jnp.zeros(())}
    with pytest.raises(
        KernelError, match=f"^one kernel takes float32 only, not {dtype.dtype}"
    ) as e:
        step(state, jnp.ones((), dtype))
    assert e.value.kind == "dtype"


def test_another_shape_is_refused(step):
    with pytest.raises(ValueError, match=r"shape \(4,\), not \(3,\)"):
        step({"x": jnp.ones(4), "n": jnp.zeros(())}, jnp.float32(1))


def test_what_it_cannot_do_is_an_error(step):
    state = {"x": jnp.ones(3), "n": jnp.zeros(())}
    with pytest.raises(KernelError, match=r"^one kernel cannot be differentiated") as caught:
        jax.grad(lambda held: step(state, held)["x"].sum())(1.0)
    assert caught.value.kind == "derivative"
    with jax.enable_x64(True), pytest.raises(KernelError, match="not float64"):
        step(state, jnp.float64(1))


def test_an_error_is_raised_in_the_callers_words():
    def explain(error):
        return ValueError(f"{error.kind}: {error}: choose another")

    step = made(impl="llvm", explain=explain)
    state = {"x": jnp.ones(3), "n": jnp.zeros(())}
    with pytest.raises(ValueError, match=r"^dtype: one kernel takes .* int32: choose another"):
        step(state, jnp.int32(1))
    with pytest.raises(ValueError, match=r"^derivative: one kernel cannot .*: choose another"):
        jax.grad(lambda held: step(state, held)["x"].sum())(1.0)
    with pytest.raises(ValueError, match=r"^platform: this program is for cuda: choose another"):
        launches(step, state, jnp.float32(1), platforms=("cuda",))


def test_a_fallback_that_nobody_reports_is_a_warning(step, monkeypatch):
    monkeypatch.setattr(gpu, "obstacle", lambda: "there is none")
    state = {"x": jnp.ones(3), "n": jnp.zeros(())}
    with pytest.warns(UserWarning, match="^a kernel is computed by XLA, slower: there is none$"):
        assert launches(step, state, jnp.float32(1), platforms=("cuda",)) == 0


def test_a_programs_platform_decides(step, monkeypatch):
    states = {"x": jnp.ones((5, 3)), "n": jnp.zeros(5)}
    arguments = jax.vmap(step), states, jnp.ones(5)
    with pytest.warns(UserWarning, match="slower: there are no kernels for this platform"):
        assert launches(*arguments, platforms=("tpu",)) == 0
    if not cpu.obstacle():
        assert launches(*arguments, platforms=("cpu",)) == 1
    monkeypatch.setattr(gpu, "obstacle", lambda: None)
    monkeypatch.setattr(gpu, "target_architecture", lambda: 90)
    assert launches(*arguments, platforms=("cuda",)) == 1


def test_what_one_platform_cannot_do_of_a_kernel_is_told_there(monkeypatch):
    monkeypatch.setattr(gpu, "obstacle", lambda: None)
    monkeypatch.setattr(gpu, "target_architecture", lambda: 90)
    x = jnp.ones((3, 4))
    short, long = (jax.vmap(fuse(lambda x, n=n: remembered(x, n))) for n in (4096, 4097))
    assert launches(short, x, platforms=("cuda",)) == 1
    reason = "arrays of 65,552 bytes for each instance, more than 65,536 on a GPU"
    with pytest.warns(UserWarning, match=f"slower: one kernel cannot do {reason}$"):
        assert launches(long, x, platforms=("cuda",)) == 0
    one = jax.vmap(fuse(lambda x: remembered(x, 4097), on_unsupported="raise"))
    with pytest.raises(KernelError, match=f"^one kernel cannot do {reason}$"):
        launches(one, x, platforms=("cuda",))
    if not cpu.obstacle():
        assert launches(long, x, platforms=("cpu",)) == 1


def test_a_kernel_that_was_asked_for_is_not_replaced():
    step = made(impl="llvm")
    state = {"x": jnp.ones(3), "n": jnp.zeros(())}
    with pytest.raises(KernelError, match=r"^this program is for cuda") as caught:
        launches(step, state, jnp.float32(1), platforms=("cuda",))
    assert caught.value.kind == "platform"


def test_it_runs_where_nothing_is_to_be_compiled():
    with jax.disable_jit():
        result = made()({"x": jnp.arange(3.0), "n": jnp.zeros(())}, jnp.float32(3))
    np.testing.assert_array_equal(result["x"], [0, 9, 18])


def test_jax_finds_what_is_not_finite_outside_of_it():
    state = {"x": jnp.array([0, jnp.nan, 2]), "n": jnp.zeros(())}
    with jax.debug_nans(True), pytest.raises(FloatingPointError, match="nan"):
        jax.jit(made())(state, jnp.float32(3))
