"""One kernel for all robots: its batches, and where there is none. What it computes: test_ptx."""

import jax
import jax.numpy as jnp
import numpy as np
import ptx_machine
import pytest

from jetbot_mjx import gpu, kernel, ptx
from jetbot_mjx.config import parse_config
from jetbot_mjx.env import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.scalarize import scalarize

on_a_gpu = pytest.mark.skipif(jax.default_backend() != "gpu", reason="there is no GPU")


@pytest.fixture
def launches(monkeypatch):
    """Kernels run by the machine in NumPy; the list tells how many robots each had."""
    counts = []

    def launch(written, leaves, results):
        def run(*arrays):
            arrays = [np.asarray(array) for array in arrays]
            counts.append(len(arrays[0]))
            outputs = [np.zeros(like.shape, np.float32) for like in results]
            robots = len(arrays[0])
            blocks = -(-robots // ptx.THREADS)
            ptx_machine.run(ptx.source(written, robots), blocks, arrays, outputs)
            return outputs

        shapes = [jax.ShapeDtypeStruct(like.shape, jnp.float32) for like in results]
        return jax.pure_callback(run, shapes, *leaves)

    monkeypatch.setattr(gpu, "launch", launch)
    return counts


@pytest.fixture(scope="module")
def step():
    def once(changing, held):
        return {"x": changing["x"] * held, "n": changing["n"] + 1}

    shapes = {"x": jnp.zeros(3), "n": jnp.zeros(())}
    program = scalarize(once, shapes, jnp.zeros(()))
    return kernel.batched(gpu, gpu.write(program, carried=2, steps=2))


def test_one_robot_needs_no_batch(step, launches):
    result = step({"x": jnp.arange(3.0), "n": jnp.zeros(())}, jnp.float32(3))
    np.testing.assert_array_equal(result["x"], [0, 9, 18])
    assert result["n"] == 2
    assert launches == [1]


def test_a_batch_is_one_launch_and_what_is_common_to_all_is_given_to_each(step, launches):
    states = {"x": jnp.ones((5, 3)), "n": jnp.arange(5.0)}
    result = jax.jit(jax.vmap(step, in_axes=(0, None)))(states, jnp.float32(2))
    np.testing.assert_array_equal(result["x"], np.full((5, 3), 4))
    np.testing.assert_array_equal(result["n"], np.arange(5) + 2)
    assert launches == [5]


def test_a_batch_of_batches_is_one_launch(step, launches):
    states = {"x": jnp.ones((2, 5, 3)), "n": jnp.zeros(5)}
    held = jnp.arange(10.0).reshape(2, 5)
    axes = {"x": 0, "n": None}
    result = jax.vmap(jax.vmap(step), in_axes=(axes, 0))(states, held)
    np.testing.assert_array_equal(result["x"][..., 1], np.arange(10).reshape(2, 5) ** 2)
    assert result["n"].shape == (2, 5)
    assert launches == [10]


def test_it_can_be_looped_over(step, launches):
    def body(states, _):
        return jax.vmap(step, in_axes=(0, None))(states, jnp.float32(2)), states["n"][0]

    states = {"x": jnp.ones((5, 3)), "n": jnp.zeros(5)}
    last, counts = jax.jit(lambda s: jax.lax.scan(body, s, length=3))(states)
    np.testing.assert_array_equal(counts, [0, 2, 4])
    np.testing.assert_array_equal(last["x"], np.full((5, 3), 64))
    assert launches == [5, 5, 5]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def write(text="text"):
    return kernel.Kernel("it", text)


def never():
    raise AssertionError("it is written already")


def test_a_text_is_written_once_for_each_key(cache):
    assert kernel.kept(b"key", write) == write()
    assert kernel.kept(b"key", never) == write()
    assert kernel.kept(b"other", lambda: write("more")) == write("more")
    assert len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("damage", [b"", b"\n", b"a" * 64 + b"\n{}"])
def test_a_damaged_text_is_written_again(cache, damage):
    kernel.kept(b"key", write)
    (path,) = cache.iterdir()
    path.write_bytes(damage)
    assert kernel.kept(b"key", write) == write()
    assert kernel.kept(b"key", never) == write()


def test_another_way_of_writing_is_another_text(cache, monkeypatch):
    kernel.kept(b"key", write)
    monkeypatch.setattr(kernel, "source_of", lambda *modules: b"another")
    assert kernel.kept(b"key", lambda: write("more")) == write("more")


def test_without_a_folder_it_is_written_every_time(tmp_path):
    before = jax.config.values["jax_compilation_cache_dir"]
    try:
        for folder in (None, str(tmp_path / "absent")):
            jax.config.update("jax_compilation_cache_dir", folder)
            assert kernel.kept(b"key", write) == write()
            assert kernel.kept(b"key", lambda: write("more")) == write("more")
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="there is a GPU")
def test_without_an_nvidia_gpu_there_is_none():
    assert not gpu.is_available()
    assert make_env(parse_config({})).physics.impl != "ptx"
    with pytest.raises(UserError, match=r"physics\.impl = ptx needs an NVIDIA GPU.* cpu"):
        make_env(parse_config({"physics": {"impl": "ptx"}}))


@pytest.fixture
def as_on_a_gpu(monkeypatch, launches):
    monkeypatch.setattr(gpu, "is_available", lambda: True)
    return launches


def test_the_environment_steps_by_the_kernel_where_there_is_one(as_on_a_gpu):
    env = make_env(parse_config({}))
    assert env.physics.impl == "ptx"
    states = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    ahead = jax.vmap(env.step)(states, jnp.ones((3, 2)))
    assert as_on_a_gpu == [3]
    assert np.all(ahead.pipeline_state.qpos[:, 0] > 0)
    np.testing.assert_allclose(ahead.pipeline_state.time, 1 / 60, rtol=1e-5)


def test_models_that_differ_from_robot_to_robot_go_into_the_kernel(as_on_a_gpu):
    env = make_env(parse_config({}))
    gains = jnp.float32([0.5, 1.0])

    def drive(gain):
        gainprm = env.mjx_model.actuator_gainprm * gain
        here = env.with_model(env.mjx_model.replace(actuator_gainprm=gainprm))
        state = env.reset(jax.random.PRNGKey(0)).pipeline_state
        return here.step_physics(state, jnp.ones(2)).qvel

    ours = jax.vmap(drive)(gains)
    assert as_on_a_gpu == [2]
    # The second robot has its preset's gain.
    state = env.reset(jax.random.PRNGKey(0)).pipeline_state
    np.testing.assert_allclose(ours[1], env.step_physics(state, jnp.ones(2)).qvel, atol=1e-5)
    assert ours[0, 6] < 0.9 * ours[1, 6]


@pytest.mark.parametrize("impl", ["auto", "ptx"])
def test_a_step_that_no_kernel_can_do_is_xlas_unless_the_kernel_was_asked_for(as_on_a_gpu, impl):
    # The library's Cholesky factor is a call, not arithmetic.
    env = make_env(parse_config({"physics": {"impl": impl, "cholesky": "library"}}))
    if impl == "auto":
        assert env.physics.impl == "xla"
        return
    with pytest.raises(UserError, match=r"physics\.impl = ptx: one kernel cannot do.*cholesky"):
        env.step_physics(env.reset(jax.random.PRNGKey(0)).pipeline_state, jnp.zeros(2))


def test_a_text_is_kept_for_each_model_and_for_what_varies_of_it(as_on_a_gpu, cache):
    def writes(env):
        before = len(list(cache.glob("kernel-*")))
        assert env.physics.impl == "ptx"
        return len(list(cache.glob("kernel-*"))) - before

    env = make_env(parse_config({}))
    assert writes(env) == 1
    assert writes(make_env(parse_config({}))) == 0
    assert writes(make_env(parse_config({"physics": {"iterations": 3}}))) == 1
    assert writes(make_env(parse_config({"robot": {"preset": "real"}}))) == 1
    friction = env.mjx_model.pair_friction
    slippery = env.mjx_model.replace(pair_friction=friction * 0.5)
    assert writes(env.with_model(slippery)) == 1
    assert writes(env.with_model(slippery)) == 0

    def varied(friction):
        return writes(env.with_model(env.mjx_model.replace(pair_friction=friction)))

    counts = []
    jax.eval_shape(lambda friction: counts.append(varied(friction)), friction)
    jax.eval_shape(lambda friction: counts.append(varied(friction)), friction)
    assert counts == [1, 0]


def test_a_program_is_the_same_whether_its_kernel_is_written_or_found(cache, monkeypatch):
    def launch(written, leaves, results):
        return [x + len(written.text) for x in results]

    monkeypatch.setattr(gpu, "is_available", lambda: True)
    monkeypatch.setattr(gpu, "launch", launch)
    programs = []
    for _ in range(2):
        env = make_env(parse_config({}))
        states = env.reset(jax.random.PRNGKey(0)).pipeline_state
        programs.append(jax.jit(env.step_physics).lower(states, jnp.zeros(2)).as_text())
    assert len(list(cache.glob("kernel-*"))) == 1
    assert programs[0] == programs[1]


@on_a_gpu
@pytest.mark.parametrize("preset", ["isaac", "real"])
def test_on_a_gpu_it_drives_as_xla_does(preset):
    robots = 256
    rng = np.random.default_rng(0)
    targets = rng.uniform(-12, 31, (16, robots, 2)).astype(np.float32)
    ends = []
    for impl in ("ptx", "xla"):
        env = make_env(parse_config({"robot": {"preset": preset}, "physics": {"impl": impl}}))
        keys = jax.random.split(jax.random.PRNGKey(0), robots)
        states = jax.jit(jax.vmap(env.reset))(keys).pipeline_state
        step = jax.jit(jax.vmap(env.step_physics))
        for ctrl in np.repeat(targets, 16, 0):
            states = step(states, ctrl)
        ends.append(np.asarray(states.qpos))
    np.testing.assert_allclose(*ends, atol=1e-3)
