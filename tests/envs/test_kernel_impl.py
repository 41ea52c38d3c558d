"""Settings choose how physics and images are computed, and errors of kernels name them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.small_physics import small_physics
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.kernel_impl import KernelImpl
from jetbot_mjx.errors import UserError
from onekernel import KernelError, UnsupportedError, cpu, gpu
from onekernel.lower import linear_algebra

CAMERA = {"task": {"observation": "camera"}, "camera": {"width": 8, "height": 8}}


@pytest.mark.parametrize("setting", ["physics.impl", "camera.impl"])
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("platform", "^{setting} = llvm: the engine's words: choose xla or auto$"),
        ("derivative", "as one kernel cannot be differentiated: choose {setting} = xla"),
        ("dtype", "^the engine's words: cast it, or choose {setting} = xla$"),
    ],
)
def test_an_error_of_a_kernel_names_the_setting_and_the_remedy(setting, kind, said):
    error = KernelImpl(setting, "llvm").explain(KernelError("the engine's words", kind))
    with pytest.raises(UserError, match=said.format(setting=setting.replace(".", r"\."))):
        raise error


def test_an_operation_that_no_kernel_can_do_is_an_error_only_if_one_was_asked_for(capsys):
    error = UnsupportedError("the operation that_is_new")
    error.place = "task.py:3"
    with pytest.raises(
        UserError, match=r"^physics\.impl = llvm: one kernel cannot do the operation"
    ):
        KernelImpl("physics.impl", "llvm").report_unsupported(error)
    KernelImpl("physics.impl", "auto").report_unsupported(error)
    said = "one kernel cannot do the operation that_is_new (task.py:3)"
    assert (
        f"slow: physics.impl: training is 5 to 11 times slower: {said}" in capsys.readouterr().err
    )


@pytest.mark.skipif(cpu.obstacle() is not None, reason="there is no such kernel here")
def test_physics_as_one_kernel_raises_errors_of_the_user():
    physics, state = small_physics(impl="llvm")
    with pytest.raises(UserError, match=r"^physics as one kernel cannot be .*physics\.impl = xla"):
        jax.grad(lambda ctrl: physics.step(state, ctrl).qvel[0])(jnp.ones(1))
    with pytest.raises(UserError, match=r"^physics\.impl = llvm: this program is for cuda: choose"):
        jax.jit(physics.step).trace(state, jnp.ones(1)).lower(lowering_platforms=("cuda",))
    # So do those of a whole step, in which physics is a part.
    env = make_env(parse_config({"physics": {"impl": "llvm"}}))
    first = jax.jit(env.reset)(jax.random.PRNGKey(0))
    with pytest.raises(UserError, match=r"^physics as one kernel cannot be .*physics\.impl = xla"):
        jax.grad(lambda action: env.step(first, action).reward)(jnp.ones(2))


@pytest.mark.skipif(cpu.obstacle() is not None, reason="there is no such kernel here")
def test_an_image_as_one_kernel_raises_errors_of_the_user():
    env = make_env(parse_config({**CAMERA, "camera": {**CAMERA["camera"], "impl": "llvm"}}))
    with pytest.raises(UserError, match=r"^camera\.impl = llvm: this program is for cuda: choose"):
        jax.jit(env.reset).trace(jax.random.PRNGKey(0)).lower(lowering_platforms=("cuda",))


@pytest.mark.slow
def test_the_remedy_helps():
    settings = {"impl": "xla", "iterations": 1}
    env = make_env(parse_config({"physics": settings}))
    state = env.reset(jax.random.PRNGKey(0)).pipeline_state
    slope = jax.grad(lambda ctrl: env.physics.step(state, ctrl).qvel[0])(jnp.ones(2))
    assert np.isfinite(slope).all()
    assert (slope > 0).all()


def test_a_step_casts_what_it_is_given():
    physics, state = small_physics()
    plain = physics.step(state, jnp.float32([4]))
    assert plain.qpos > 0
    for dtype in (jnp.bfloat16, jnp.float16, jnp.int32):
        cast = physics.step(state, jnp.array([4], dtype))
        np.testing.assert_array_equal(cast.qpos, plain.qpos)


@pytest.mark.skipif(gpu.obstacle() is None, reason="there is a GPU")
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
def test_a_step_that_no_kernel_can_do_is_xlas_unless_the_kernel_was_asked_for(impl, monkeypatch):
    # The slider's matrix has one row.
    monkeypatch.setattr(linear_algebra, "MAX_ROWS", 0)
    if impl == "llvm" and cpu.obstacle() is not None:
        pytest.skip("there is no such kernel here")
    physics, state = small_physics(impl=impl)
    if impl == "auto":
        assert physics.impl == "xla"
        return
    with pytest.raises(UserError, match=r"physics\.impl = llvm: one kernel cannot do.*cholesky"):
        physics.step(state, jnp.zeros(1))
