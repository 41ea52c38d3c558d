"""Kernels that XLA calls on a CPU: batches, devices, and files that are kept of them."""

import functools
import json
import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import Mesh, PartitionSpec

from helpers import gliding
from helpers.large_arrays import BYTES, remembered
from helpers.small_kernels import launches
from helpers.small_physics import small_physics
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import program_key
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.program_key import open_program_cache
from jetbot_mjx.errors import UserError
from onekernel import cpu, fuse, kernel
from onekernel.codegen import LlvmWriter
from onekernel.cpu import xla_call
from onekernel.lower.jaxpr import scalarize

pytestmark = pytest.mark.cpu

DEVICES = 8

needs_it = pytest.mark.skipif(
    cpu.obstacle() is not None, reason="llvmlite compiles nothing for XLA"
)


def kernel_of(function, *shapes, carried=1, steps=1):
    program = scalarize(function, *shapes)
    return kernel.Kernel(program, carried=carried, steps=steps, fallback=list, impl="llvm")


def made_step():
    def once(changing, held):
        return {"x": changing["x"] * held, "n": changing["n"] + 1}

    shapes = {"x": jnp.zeros(3), "n": jnp.zeros(())}
    return kernel_of(once, shapes, jnp.zeros(()), carried=2, steps=2).as_step()


@pytest.fixture(scope="module")
def step():
    return made_step()


@pytest.fixture
def cache(tmp_path):
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


@needs_it
def test_one_robot_or_any_batch_of_batches_in_a_loop(step):
    def body(states, held):
        return jax.vmap(jax.vmap(step), in_axes=(0, None))(states, held), states["n"][0, 0]

    states = {"x": jnp.ones((2, 17, 3)), "n": jnp.zeros((2, 17))}
    held = jnp.broadcast_to(jnp.arange(1.0, 4.0)[:, None], (3, 17))
    last, counts = jax.jit(lambda s: jax.lax.scan(body, s, held))(states)
    np.testing.assert_array_equal(counts, [0, 2, 4])
    np.testing.assert_array_equal(last["x"], np.full((2, 17, 3), 36))
    alone = step({"x": jnp.arange(3.0), "n": jnp.zeros(())}, jnp.float32(3))
    np.testing.assert_array_equal(alone["x"], [0, 9, 18])


@pytest.fixture(scope="module", params=["isaac", pytest.param("real", marks=pytest.mark.slow)])
def driven(request):
    """An environment of each preset, and a function that drives so many robots with targets."""
    env = make_env(parse_config({"robot": {"preset": request.param}, "physics": {"impl": "llvm"}}))
    assert env.physics.impl == "llvm"
    return env, functools.partial(drive, env)


def drive(env, targets):
    """Where robots end after targets (t, n, 2), each held for 16 steps."""

    @jax.jit
    def run(states, targets):
        step = jax.vmap(env.physics.step)

        def hold(states, target):
            return jax.lax.fori_loop(0, 16, lambda _, s: step(s, target), states), None

        return jax.lax.scan(hold, states, targets)[0]

    keys = jax.random.split(jax.random.PRNGKey(0), targets.shape[1])
    return run(jax.jit(jax.vmap(env.reset))(keys).pipeline_state, targets)


def drawn(robots, holds=16):
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.uniform(-12, 31, (holds, robots, 2)), jnp.float32)


# In `envs/test_cholesky.py` robots quickly make 16 steps by a kernel and by XLA, and in
# `envs/test_physics.py` 256 by a kernel and by C MuJoCo.
@pytest.mark.slow
@needs_it
def test_it_drives_as_xla_does(driven):
    env, drive_it = driven
    values = env.config.model_dump(mode="json")
    values["physics"]["impl"] = "xla"
    ours, theirs = drive_it(drawn(24)), drive(make_env(parse_config(values)), drawn(24))
    # After 256 environment steps; a wheel has turned some 100 rad by then.
    np.testing.assert_allclose(ours.qpos[:, :7], theirs.qpos[:, :7], atol=1e-3)
    np.testing.assert_allclose(ours.qpos[:, 7:], theirs.qpos[:, 7:], atol=5e-2)
    assert np.ptp(np.asarray(ours.qpos[:, 0])) > 0.5


@pytest.mark.slow
@needs_it
def test_a_robots_bits_do_not_depend_on_those_beside_it(driven):
    _, drive_it = driven
    targets = drawn(1000, holds=2)
    together = drive_it(targets)
    for robots in (
        1,
        cpu.host_processor().lanes - 1,
        cpu.host_processor().lanes + 1,
    ):
        few = drive_it(targets[:, :robots])
        np.testing.assert_array_equal(few.qpos, together.qpos[:robots])
    spoilt = drive_it(targets.at[0, 3].set(jnp.nan))
    others = np.delete(np.arange(1000), 3)
    assert not np.isfinite(spoilt.qpos[3]).any()
    np.testing.assert_array_equal(spoilt.qpos[others], together.qpos[others])


def divided(x):
    """A product and a sum around a selection, for whose division LLVM would make a branch."""
    a, b, p, q, r = x
    product = a * b
    return product + jnp.where(r < a, p / q, r)


def looked_up(x):
    """A loop that ends for each instance by itself, and reads an array and a table."""
    table = jnp.asarray(np.random.default_rng(1).normal(size=300), jnp.float32)

    def again(state):
        y, place, count = state
        y = y * 0.75 + table[place] * jnp.sin(x[place % 5]) + jnp.exp(-y * y) / (2 + y * y)
        return y, (place * 7 + jnp.int32(y * 10)) % 300, count + 1

    start = x[0], jnp.int32(4), jnp.int32(0)
    return jax.lax.while_loop(lambda s: (s[0] < 1) & (s[2] < 20), again, start)


def kept(x):
    """A scan that returns the number of every step."""
    return jax.lax.scan(lambda y, _: (y - 0.1 * y * jnp.tanh(y) * x[1], y), x[0], length=70)[1]


ALONE = {
    "a selection": divided,
    "an array": looked_up,
    "a scan": kept,
    "a sort": jnp.sort,
    "extremes": lambda x: (jnp.maximum(x * 0, -x * 0), jnp.minimum(-x * 0, x * 0)),
}


@needs_it
@pytest.mark.parametrize("instances", [1, 3, 8, 9])
@pytest.mark.parametrize("name", ALONE)
def test_an_instances_bits_do_not_depend_on_how_many_there_are(name, instances):
    one = jax.vmap(fuse(ALONE[name], on_unsupported="raise"))
    drawn = np.float32(np.random.default_rng(0).normal(size=(256 // instances, instances, 5)))
    alone = jax.jit(lambda x: jax.lax.map(one, x))(drawn)
    together = jax.jit(one)(drawn.reshape(-1, 5))
    for few, many in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
        words = np.asarray(few).view(np.uint32)
        np.testing.assert_array_equal(words.reshape(many.shape), np.asarray(many).view(np.uint32))


@needs_it
def test_few_instances_have_few_lanes():
    most = cpu.host_processor().lanes
    assert [cpu.lanes_for(n) for n in (1, 2, 4, most, 1000)] == [1, 4, 4, most, most]
    text = cpu.kernel_text(kernel_of(lambda x: x + 1, jnp.zeros(()), steps=1), instances=1)
    assert "x float>" not in text


@needs_it
def test_instances_with_large_arrays_have_few_lanes(monkeypatch):
    host = cpu.host_processor()._replace(lanes=16)
    monkeypatch.setattr(cpu, "host_processor", lambda: host)
    mib = 1 << 20
    sizes = (mib // 2, mib // 2 + 1, mib, mib + 1, 2 * mib, 2 * mib + 1, 9 * mib)
    assert [cpu.lanes_for(1000, size) for size in sizes] == [16, 8, 8, 4, 4, 1, 1]
    assert [cpu.lanes_for(3, size) for size in (2 * mib, 2 * mib + 1)] == [4, 1]
    assert cpu.lanes_for(1, 9 * mib) == 1


@pytest.fixture(scope="module")
def long():
    return fuse(remembered, on_unsupported="raise")


def vectors(*shape):
    return jnp.asarray(np.random.default_rng(0).normal(size=(*shape, 4)), jnp.float32)


def assert_close(one, other):
    np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


@needs_it
def test_arrays_of_many_instances_are_not_on_the_stack(long):
    x = vectors(256)
    kernel = long.lowered(x[0]).one
    assert kernel.array_bytes == BYTES == 704_000
    # The arrays of all lanes are larger than the stack of a thread.
    lanes = cpu.lanes_for(256, BYTES)
    assert cpu.xla_call.scratch_bytes(kernel, lanes) == lanes * BYTES
    batch = jax.vmap(long)
    assert launches(long, x[0]) == launches(batch, x) == 1
    ours = jax.jit(batch)(x)
    assert_close(ours, jax.jit(jax.vmap(remembered))(x))
    np.testing.assert_array_equal(jax.jit(long)(x[7]), ours[7])


@needs_it
@pytest.mark.parametrize("instances", [1, 33])
def test_what_a_step_returns_is_side_by_side_whatever_its_size(instances):
    def function(x):
        def forth(c, _):
            c = 0.9 * c + x[::-1]
            row = c.astype(jnp.float32), c, c > 0.5, (c * 1e3).astype(int), jnp.int32(c[0] * 9)
            return c, row

        def back(total, row):
            narrow, wide, truth, whole, short = row
            return total * 0.7 + jnp.where(truth, wide, whole) - narrow * short, None

        end, rows = jax.lax.scan(forth, x, length=300)
        return jax.lax.scan(back, end, rows, reverse=True)[0], rows[1][7]

    with jax.enable_x64(True):
        x = np.random.default_rng(0).normal(size=(instances, 3))
        ours = jax.jit(jax.vmap(fuse(function, on_unsupported="raise")))(x)
        for one, other in zip(ours, jax.jit(jax.vmap(function))(x), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-10)


@needs_it
def test_calls_at_once_have_arrays_of_their_own(long):
    program, x = jax.jit(jax.vmap(long)), vectors(2, 64)
    expected = np.stack([program(each) for each in x])
    found = {}

    def call(which):
        for count in range(4):
            found[which, count] = np.asarray(program(x[which]))

    threads = [threading.Thread(target=call, args=[which]) for which in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    for (which, _), result in found.items():
        np.testing.assert_array_equal(result, expected[which])


@needs_it
def test_a_scan_takes_a_kernel_with_a_large_array(long):
    def moved(function):
        return lambda x: jax.lax.scan(lambda x, _: (x - 0.1 * function(x), x), x, length=3)

    x = vectors(3)
    ours, theirs = (jax.jit(jax.vmap(moved(f)))(x) for f in (long, remembered))
    jax.tree.map(assert_close, ours, theirs)


@needs_it
def test_a_gradient_that_stores_much_is_one_kernel():
    def loss(x):
        return jnp.square(remembered(x, 11_000)).sum()

    x = vectors(5)
    one = jax.vmap(fuse(jax.grad(loss), on_unsupported="raise"))
    assert launches(one, x) == 1
    assert fuse(jax.grad(loss)).lowered(x[0]).one.array_bytes >= 700_000
    # The gradient of the kernel itself would pass what is stored from one kernel to another.
    told = []
    other = jax.vmap(jax.grad(fuse(loss, on_unsupported=told.append)))
    theirs = jax.jit(jax.vmap(jax.grad(loss)))(x)
    assert_close(jax.jit(one)(x), theirs)
    assert_close(jax.jit(other)(x), theirs)
    assert {str(x).partition(" of ")[0] for x in told} == {"arguments and results"}


@needs_it
def test_models_that_differ_from_robot_to_robot_go_into_the_kernel():
    physics, state = small_physics()
    gains = jnp.float32([0.5, 1.0])

    def one(gain):
        gainprm = physics.model.actuator_gainprm * gain
        here = physics.with_model(physics.model.replace(actuator_gainprm=gainprm))
        assert here.impl == "llvm"
        return here.step(state, jnp.ones(1)).qvel

    ours = jax.vmap(one)(gains)
    np.testing.assert_allclose(ours[1], physics.step(state, jnp.ones(1)).qvel, atol=1e-5)
    assert 0 < ours[0, 0] < 0.9 * ours[1, 0]


# The quick tests train on eight devices, in `training/test_eight_devices.py`.
@pytest.mark.slow
@needs_it
def test_on_eight_devices_at_once_each_steps_its_own():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={DEVICES}"
    done = subprocess.run(
        [sys.executable, __file__],
        env={**os.environ, "XLA_FLAGS": flags.strip()},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    # MJX prints lines of its own where its optional part Warp is missing.
    assert json.loads(done.stdout.splitlines()[-1]) == [
        4.0 ** (2 * steps) for steps in range(1, DEVICES + 1)
    ]


def tell():
    """The other process: every device with robots, and work for several threads."""
    step = made_step()
    mesh = Mesh(np.array(jax.devices()), ("i",))
    assert mesh.size == DEVICES

    def on_one(states, held):
        states = jax.lax.fori_loop(0, 100, lambda _, s: jax.vmap(step)(s, held), states)
        return states["x"][:, 0]

    robots = DEVICES * 500
    factor = 4.0 ** (np.arange(DEVICES) / 100 + 1 / 100)
    states = {"x": jnp.ones((robots, 3)), "n": jnp.zeros(robots)}
    spec = PartitionSpec("i")
    on_all = jax.jit(
        jax.shard_map(on_one, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    )
    held = jnp.asarray(np.repeat(factor, 500), jnp.float32)
    ends = np.asarray(on_all(states, held)).reshape(DEVICES, 500)
    assert (ends == ends[:, :1]).all()
    print(json.dumps([float(4.0 ** round(np.log(x) / np.log(4))) for x in ends[:, 0]]))


@needs_it
def test_a_call_without_memory_raises_and_the_next_one_runs():
    def increment(scratch):
        block = LlvmWriter("block", *cpu.BLOCK_PARAMETERS)
        job, index, memory = block.parameters
        memory[0] = cpu.array_of(job, 0)[index] + 1.0
        cpu.array_of(job, 1)[index] = memory[0]
        machine = cpu.host_processor().machine
        text = cpu.call_text([block], blocks_per_thread=1, scratch=scratch, machine=machine)
        return jax.jit(lambda x: cpu.launch_text(text, [x], [x])[0])

    x = jnp.arange(20.0)
    for _ in range(2):
        with pytest.raises(jax.errors.JaxRuntimeError, match="there is no memory for a kernel"):
            increment(2**62)(x).block_until_ready()
    np.testing.assert_array_equal(increment(64)(x), x + 1)


@needs_it
def test_threads_that_trace_at_once_compile_it_once(monkeypatch):
    compiled = []
    original = cpu._compile
    monkeypatch.setattr(cpu, "_compile", lambda text: compiled.append(text) or original(text))
    shape = jax.ShapeDtypeStruct((2,), jnp.float32)
    written = kernel_of(lambda x: x - 41.5, shape)
    x = jnp.ones((3, 2))
    results = []

    def trace():
        results.append(jax.jit(lambda x: cpu.launch(written, [x])[0])(x))

    with_no_cache = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        threads = [threading.Thread(target=trace) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        jax.config.update("jax_compilation_cache_dir", with_no_cache)
    assert len(compiled) == 1
    np.testing.assert_array_equal(results, np.full((4, 3, 2), -40.5))


@needs_it
def test_machine_code_is_kept_for_its_text_and_its_processor(cache, monkeypatch):
    compiled = []
    monkeypatch.setattr(cpu, "_compile", lambda text: compiled.append(text) or b"code")

    def compiles(text="text"):
        before = len(compiled)
        assert cpu._machine_code(text) == b"code"
        return len(compiled) - before

    assert (compiles(), compiles()) == (1, 0)
    (kept,) = cache.glob("object-*")
    kept.write_bytes(kept.read_bytes()[:-1])
    assert (compiles(), compiles()) == (1, 0)
    assert (compiles("other"), compiles("other")) == (1, 0)
    host = cpu.host_processor()
    for other in ({"name": "x86-64"}, {"features": ""}, {"version": "0"}):
        monkeypatch.setattr(cpu, "host_processor", lambda other=other: host._replace(**other))
        assert (compiles(), compiles()) == (1, 0)


@needs_it
def test_another_kernel_has_another_name():
    shape = jax.ShapeDtypeStruct((2,), jnp.float32)
    texts = [
        cpu.kernel_text(kernel_of(lambda x, n=n: x + n, shape, steps=steps))
        for n, steps in ((1.0, 1), (2.0, 1), (1.0, 2))
    ]
    assert len({cpu.registered(text) for text in texts}) == 3


@pytest.fixture
def fresh():
    """Where JAX keeps nothing: what it found in its own cache, a CPU could not write again."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()  # or what an earlier test had asked for would hold
    yield
    jax.config.update("jax_enable_compilation_cache", before)
    compilation_cache.reset_cache()


@needs_it
def test_a_kept_program_brings_its_kernels_into_the_next_process(
    cache, fresh, own_tasks, monkeypatch
):
    monkeypatch.setattr(program_key, "BUILT_IN_TASKS", own_tasks)
    shape = jax.ShapeDtypeStruct((2,), jnp.float32)
    written = kernel_of(lambda x: x * 2.5, shape)
    x = np.ones((3, 2), np.float32)
    config = parse_config({})
    program = open_program_cache(config).compile(
        "test", lambda: jax.jit(lambda x: cpu.launch(written, [x])[0]).trace(x)
    )
    (name,) = cpu.kernels_in(program.as_text())
    # As in a new process, but that XLA knows the name already.
    monkeypatch.setattr(cpu, "_loaded", {})
    told = []
    monkeypatch.setattr(jax.ffi, "register_ffi_target", lambda name, *_, **__: told.append(name))
    found = open_program_cache(config).find("test")
    assert told == [name]
    np.testing.assert_array_equal(found(x), np.full((3, 2), 2.5))


@pytest.fixture
def asked_anew():
    cpu.obstacle.cache_clear()
    cpu.host_processor.cache_clear()
    cpu._binding.cache_clear()
    yield
    cpu.obstacle.cache_clear()
    cpu.host_processor.cache_clear()
    cpu._binding.cache_clear()


def without_llvmlite(monkeypatch):
    monkeypatch.setitem(sys.modules, "llvmlite.binding", None)


def with_an_xla_of_another_version(monkeypatch):
    own, other = "store i32 3, ptr %minor.at", "store i32 99, ptr %minor.at"
    assert own in xla_call.TEXT
    monkeypatch.setattr(xla_call, "TEXT", xla_call.TEXT.replace(own, other))


def with_an_xla_of_other_structures(monkeypatch):
    monkeypatch.setattr(xla_call, "TEXT", xla_call.TEXT.replace("i64 168", "i64 176"))


def on_another_processor(monkeypatch):
    monkeypatch.setattr(xla_call, "MACHINES", ())


@pytest.mark.parametrize(
    "where",
    [
        without_llvmlite,
        with_an_xla_of_another_version,
        with_an_xla_of_other_structures,
        on_another_processor,
    ],
)
def test_where_it_cannot_be_had_xla_makes_the_step_and_one_line_says_so(
    asked_anew, where, monkeypatch, capsys
):
    where(monkeypatch)
    env = make_env(parse_config({}))
    physics, state = small_physics()
    with gliding.everywhere():
        jax.eval_shape(lambda key: env.step(env.reset(key), jnp.zeros(2)), jax.random.PRNGKey(0))
    for _ in range(2):
        jax.eval_shape(physics.step, state, jnp.zeros(1))
    assert env.physics.impl == physics.impl == "xla"
    line = f"slow: physics.impl: training is 5 to 11 times slower: {cpu.obstacle()}\n"
    assert capsys.readouterr().err == line
    with pytest.raises(UserError, match=r"physics\.impl = llvm: .+; or choose xla or auto"):
        make_env(parse_config({"physics": {"impl": "llvm"}}))


if __name__ == "__main__":
    tell()
