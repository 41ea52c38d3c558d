"""One kernel for all robots: its batches, its types, its platforms. What it computes: test_llvm."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.compiler import kernel, llvm_backend, ptx_backend
from jetbot_mjx.compiler.lower_jaxpr import scalarize
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.errors import UserError

if all(backend.obstacle() for backend in (llvm_backend, ptx_backend)):
    pytest.skip("there is no kernel here", allow_module_level=True)


def once(changing, held):
    return {"x": changing["x"] * held, "n": changing["n"] + 1}


def fallback(n, x, held):
    """The leaves of two steps, as a dictionary orders them."""
    return [n + 2, x * held * held]


def made(impl="auto"):
    shapes = {"x": jnp.zeros(3), "n": jnp.zeros(())}
    program = scalarize(once, shapes, jnp.zeros(()))
    return kernel.as_step(kernel.Kernel(program, carried=2, steps=2, fallback=fallback, impl=impl))


@pytest.fixture(scope="module")
def step():
    return made()


def launches(function, *arguments, platforms=None):
    """How many kernels a program calls on the platform that it is lowered for."""
    # A function of its own: what was lowered before would be taken again.
    traced = jax.jit(lambda *x: function(*x)).trace(*arguments)
    text = traced.lower(lowering_platforms=platforms).as_text()
    return text.count("custom_call @jetbot_mjx_") + text.count(
        f"custom_call @{ptx_backend._TARGET}"
    )


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
    with pytest.raises(UserError, match=r"float32 only, not .*: cast it, or .*impl = xla"):
        step(state, jnp.ones((), dtype))


def test_another_shape_is_refused(step):
    with pytest.raises(ValueError, match=r"shape \(4,\), not \(3,\)"):
        step({"x": jnp.ones(4), "n": jnp.zeros(())}, jnp.float32(1))


def test_what_it_cannot_do_names_the_remedy(step):
    state = {"x": jnp.ones(3), "n": jnp.zeros(())}
    with pytest.raises(UserError, match=r"cannot be differentiated: choose physics\.impl = xla"):
        jax.grad(lambda held: step(state, held)["x"].sum())(1.0)
    with jax.enable_x64(True), pytest.raises(UserError, match=r"not float64: .*impl = xla"):
        step(state, jnp.float64(1))


@pytest.mark.slow
def test_the_remedy_helps():
    settings = {"impl": "xla", "iterations": 1}
    env = make_env(parse_config({"physics": settings}))
    state = env.reset(jax.random.PRNGKey(0)).pipeline_state
    slope = jax.grad(lambda ctrl: env.step_physics(state, ctrl).qvel[0])(jnp.ones(2))
    assert np.isfinite(slope).all()
    assert (slope > 0).all()


def test_a_programs_platform_decides(step, monkeypatch):
    states = {"x": jnp.ones((5, 3)), "n": jnp.zeros(5)}
    arguments = jax.vmap(step), states, jnp.ones(5)
    assert launches(*arguments, platforms=("tpu",)) == 0
    if not llvm_backend.obstacle():
        assert launches(*arguments, platforms=("cpu",)) == 1
    monkeypatch.setattr(ptx_backend, "obstacle", lambda: None)
    monkeypatch.setattr(ptx_backend, "target_architecture", lambda: 90)
    assert launches(*arguments, platforms=("cuda",)) == 1
    monkeypatch.setattr(ptx_backend, "obstacle", lambda: "there is none")
    assert launches(*arguments, platforms=("cuda",)) == 0


def test_a_kernel_that_was_asked_for_is_not_replaced():
    step = made(impl="llvm")
    state = {"x": jnp.ones(3), "n": jnp.zeros(())}
    with pytest.raises(UserError, match=r"physics\.impl = llvm: this program is for cuda"):
        launches(step, state, jnp.float32(1), platforms=("cuda",))


def test_a_step_casts_what_it_is_given():
    env = make_env(parse_config({}))
    state = env.reset(jax.random.PRNGKey(0)).pipeline_state
    plain = env.physics.step(state, jnp.float32([4, 8]))
    for dtype in (jnp.bfloat16, jnp.float16, jnp.int32):
        cast = env.physics.step(state, jnp.array([4, 8], dtype))
        np.testing.assert_array_equal(cast.qpos, plain.qpos)


@pytest.mark.skipif(ptx_backend.obstacle() is None, reason="there is a GPU")
def test_without_an_nvidia_gpu_there_is_none():
    with pytest.raises(
        UserError, match=r"physics\.impl = ptx: there is no NVIDIA GPU.* xla or auto"
    ):
        make_env(parse_config({"physics": {"impl": "ptx"}}))
    with pytest.raises(
        UserError, match=r"camera\.impl = ptx: there is no NVIDIA GPU.* xla or auto"
    ):
        make_env(parse_config({"task": {"observation": "camera"}, "camera": {"impl": "ptx"}}))


def test_a_run_with_a_kernel_of_one_device_can_be_used_on_any():
    there = parse_config({"physics": {"impl": "ptx"}, "camera": {"impl": "ptx"}})
    here = there.for_any_device()
    assert (here.physics.impl, here.camera.impl) == ("auto", "auto")
    xla = parse_config({"physics": {"impl": "xla"}, "camera": {"impl": "xla"}})
    assert xla.for_any_device() == xla


@pytest.mark.parametrize("impl", ["auto", "llvm"])
def test_a_step_that_no_kernel_can_do_is_xlas_unless_the_kernel_was_asked_for(impl):
    # The library's Cholesky factor is a call, not arithmetic.
    if impl == "llvm" and llvm_backend.obstacle() is not None:
        pytest.skip("there is no such kernel here")
    env = make_env(parse_config({"physics": {"impl": impl, "cholesky": "library"}}))
    if impl == "auto":
        assert env.physics.impl == "xla"
        return
    with pytest.raises(UserError, match=r"physics\.impl = llvm: one kernel cannot do.*cholesky"):
        env.step_physics(env.reset(jax.random.PRNGKey(0)).pipeline_state, jnp.zeros(2))


def test_it_runs_where_nothing_is_to_be_compiled():
    with jax.disable_jit():
        result = made()({"x": jnp.arange(3.0), "n": jnp.zeros(())}, jnp.float32(3))
    np.testing.assert_array_equal(result["x"], [0, 9, 18])
