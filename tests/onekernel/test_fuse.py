"""The public function `fuse`: what it takes, what it says, and what JAX may do with it."""

import re
import warnings
from typing import NamedTuple

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

import onekernel
from helpers.large_arrays import remembered
from helpers.small_kernels import launches
from onekernel import KernelError, UnsupportedError, cpu, fuse, fused, traced
from onekernel.build import BACKENDS
from onekernel.lower import control_flow

pytestmark = [
    pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels here"),
]


@pytest.fixture(autouse=True)
def checked(monkeypatch):
    """Compare each kernel with XLA before its first use."""
    monkeypatch.setenv(fused.CHECK, "1")


def break_kernels(monkeypatch):
    for backend in BACKENDS:
        monkeypatch.setattr(backend, "obstacle", lambda: "it is broken")


def lorenz(state, sigma=10.0, rho=28.0, beta=8 / 3):
    x, y, z = state
    return jnp.stack([sigma * (y - x), x * (rho - z) - y, x * y - beta * z])


def states(count=21, size=3):
    return np.float32(np.random.default_rng(0).normal(size=(count, size)))


class Walk(NamedTuple):
    place: jax.Array
    key: jax.Array
    count: jax.Array
    is_done: jax.Array


def walk(one, length):
    key, drawn = jax.random.split(one.key)
    place = one.place + length * jax.random.normal(drawn, (2,))
    return Walk(place, key, one.count + 1, one.is_done | (jnp.abs(place).max() > 1)), drawn


def walks(count):
    return Walk(
        jnp.zeros((count, 2)),
        jax.random.split(jax.random.key(3), count),
        jnp.arange(count, dtype=jnp.uint32),
        jnp.zeros(count, bool),
    )


def same(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), rtol=1e-5, atol=1e-6)


def test_trees_with_random_keys_numbers_and_truths_are_one_kernel():
    step = jax.vmap(fuse(walk), in_axes=(0, None))
    same(step(walks(7), 0.5), jax.vmap(walk, in_axes=(0, None))(walks(7), 0.5))
    assert launches(step, walks(7), 0.5) == 1


def test_keywords_and_defaults_are_arguments():
    one = fuse(lorenz)
    ours, theirs = (jax.vmap(lambda x, f=f: f(x, rho=20.0))(states()) for f in (one, lorenz))
    same(ours, theirs)
    same(one(states()[0], beta=np.float32(2)), lorenz(states()[0], beta=2.0))


def test_it_is_a_decorator_of_functions_and_methods():
    @fuse
    def double(x):
        """Double it."""
        return 2 * x

    @fuse(on_unsupported="raise")
    def triple(x):
        return 3 * x

    class Scale:
        factor = 4.0

        @fuse
        def apply(self, x):
            return self.factor * x

    assert double.__doc__ == "Double it."
    assert [float(double(1.0)), float(triple(1.0))] == [2.0, 3.0]
    # An object that is no pytree of arrays cannot be an argument.
    with pytest.raises(TypeError, match=r"not <.*Scale object at .*>: fix other arguments with"):
        Scale().apply(1.0)


def test_a_word_is_no_argument():
    with pytest.raises(TypeError, match="arrays and numbers, not 'up': fix other arguments with"):
        fuse(lambda x, way: x if way == "up" else -x)(1.0, "up")
    with pytest.raises(TypeError, match="arrays and numbers, not 'up': leave other results out"):
        fuse(lambda x: (x, "up"))(1.0)


def test_results_may_be_pythons_numbers():
    def step(x):
        return {"next": x + 1, "reward": 1.0, "done": False, "count": 3, "gain": np.float64(2)}

    ours = jax.vmap(fuse(step, on_unsupported="raise"))(states())
    same(ours, jax.jit(jax.vmap(step))(states()))


def test_jit_scan_and_vmap_take_it():
    step = fuse(lambda x: x + 0.01 * lorenz(x))

    def run(one):
        trips = lambda x, _: (jax.vmap(one)(x), None)  # noqa: E731
        return jax.jit(lambda x: jax.lax.scan(trips, x, length=50)[0])

    same(run(step)(states()), run(lambda x: x + 0.01 * lorenz(x))(states()))


def test_a_fused_function_inside_another_is_part_of_its_kernel():
    slope = fuse(lorenz)
    step = fuse(lambda x: x + 0.01 * slope(x) + 0.01 * slope(x + 1))
    assert launches(jax.vmap(step), states()) == 1


def sharded(function):
    """A function of a batch, each device's share of it by itself."""
    mesh = jax.make_mesh((1,), ("x",), axis_types=(jax.sharding.AxisType.Auto,))
    spec = jax.sharding.PartitionSpec("x")
    return jax.jit(jax.shard_map(jax.vmap(function), mesh=mesh, in_specs=spec, out_specs=spec))


def test_shard_map_takes_it_before_and_after_others_do():
    for first, second in [(sharded, jax.vmap), (jax.vmap, sharded)]:
        one = fuse(lorenz)
        same(first(one)(states()), jax.vmap(lorenz)(states()))
        same(second(one)(states()), jax.vmap(lorenz)(states()))
        assert launches(sharded(one), states()) == 1


@pytest.mark.filterwarnings("ignore:XLA computes.*(spectrum|it is broken):UserWarning")
def test_shard_map_takes_its_derivative_and_what_takes_its_place(monkeypatch):
    one = fuse(lorenz)
    gradient = jax.grad(lambda x: one(x).sum())
    same(sharded(gradient)(states()), jax.vmap(gradient)(states()))
    unknown = fuse(spectrum)
    same(sharded(unknown)(states()), jax.vmap(spectrum)(states()))
    break_kernels(monkeypatch)
    same(sharded(fuse(lorenz))(states()), jax.vmap(lorenz)(states()))


def spectrum(x):
    return jnp.abs(jnp.fft.rfft(x))


def test_what_no_kernel_can_do_is_told_once_with_its_line():
    one = fuse(spectrum)
    x = np.ones(4, np.float32)
    reason = r"one kernel cannot do the operation fft \(.*test_fuse.py:\d+.*\)$"
    with pytest.warns(UserWarning, match=f"^XLA computes spectrum, slower: {reason}") as told:
        results = [one(x) for _ in range(2)]
    assert len(told) == 1
    same(results[1], spectrum(x))


def test_no_line_of_the_package_is_told_where_a_library_function_is_fused():
    # JAX records the innermost frames only, so the user's line may be unknown.
    with pytest.raises(UnsupportedError, match=r"^the operation eigh") as raised:
        fuse(jnp.linalg.eigh, on_unsupported="raise")(jnp.eye(3))
    assert "fused.py" not in str(raised.value)


def test_it_can_be_silent_an_error_or_the_callers_business():
    x = np.ones(4, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fuse(spectrum, on_unsupported="xla")(x)
    with pytest.raises(UnsupportedError, match="the operation fft"):
        fuse(spectrum, on_unsupported="raise")(x)
    reasons = []
    fuse(spectrum, on_unsupported=reasons.append)(x)
    assert [str(x)[:17] for x in reasons] == ["the operation fft"]
    with pytest.raises(ValueError, match=re.escape("on_unsupported = 'never': choose 'warn', ")):
        fuse(spectrum, on_unsupported="never")


@pytest.mark.parametrize("dtype", ["float16", "int8"])
def test_numbers_of_another_width_are_named(dtype):
    with pytest.raises(UnsupportedError, match=f"arguments or results of {dtype}"):
        fuse(lambda x: x * 2, on_unsupported="raise")(jnp.ones(2, dtype))


def test_a_batch_without_vmap_is_refused_before_it_is_lowered():
    def double(x):
        return 2 * x

    message = "^arguments and results of 240,000 bytes for each instance, more than 65,536$"
    with pytest.raises(UnsupportedError, match=message):
        fuse(double, on_unsupported="raise")(jnp.ones((10_000, 3)))

    def trace(x):
        return jax.lax.scan(lambda x, _: (x + 0.01 * lorenz(x),) * 2, x, length=6000)

    with pytest.raises(UnsupportedError, match="results of 72,024 bytes"):
        fuse(trace, on_unsupported="raise")(jnp.ones(3))


def test_of_arrays_that_take_too_much_memory_one_line_is_told_and_xla_computes(monkeypatch):
    monkeypatch.setattr(control_flow, "MAX_ARRAY_BYTES", 4 * 4 * 2000 - 1)

    def long(x):
        return remembered(x, 2000)

    x = jnp.float32([0.1, 0.2, 0.3, 0.4])
    reason = "^XLA computes long, slower: one kernel cannot do arrays of 32,000 bytes .* 31,999"
    with pytest.warns(UserWarning, match=reason) as told:
        ours = fuse(long)(x)
    assert len(told) == 1
    np.testing.assert_allclose(ours, long(x), rtol=1e-6)


@pytest.mark.parametrize("way", ["jit", "vmap", "one instance"])
def test_with_debug_nans_jax_names_the_operation(way):
    one = fuse(lambda x: jnp.sqrt(jnp.log(x)))
    ways = {
        "jit": lambda: jax.jit(jax.vmap(one))(-np.ones(3, np.float32)),
        "vmap": lambda: jax.vmap(one)(-np.ones(3, np.float32)),
        "one instance": lambda: one(-1.0),
    }
    ways[way]()
    with jax.debug_nans(True), pytest.raises(FloatingPointError, match="encountered in log"):
        ways[way]()
    with jax.debug_infs(True), pytest.raises(FloatingPointError, match="encountered in log"):
        one(0.0)


def test_a_check_passes_where_transfers_are_forbidden():
    x = jnp.asarray(states())
    with jax.transfer_guard("disallow"):
        ours = jax.jit(jax.vmap(fuse(lorenz)))(x)
    same(ours, jax.vmap(lorenz)(x))


def test_a_platform_without_kernels_is_told(monkeypatch):
    break_kernels(monkeypatch)
    with pytest.warns(UserWarning, match="^XLA computes lorenz, slower: it is broken$"):
        same(jax.vmap(fuse(lorenz))(states()), jax.vmap(lorenz)(states()))
    with pytest.raises(KernelError, match="it is broken"):
        jax.vmap(fuse(lorenz, on_unsupported="raise"))(states())


def test_a_wrong_kernel_is_found_before_its_first_use(monkeypatch):
    lowered = traced.scalarize_part

    def wrong(traced, arguments, results, **options):
        # The kernel returns its first result twice.
        return lowered(traced, arguments, [results[0]] * len(results), **options)

    monkeypatch.setattr(traced, "scalarize_part", wrong)
    # The first number that differs is told, not the first of all.
    both = fuse(lambda x: (x, jnp.where(jnp.arange(3) > 1, 123.0, x)))
    message = r"^result 1 of a kernel is not XLA's: \S+ instead of 123 at \[2\] in 65 of 65 random"
    with pytest.raises(KernelError, match=message) as raised:
        both(np.ones(3, np.float32))
    assert raised.value.kind == "check"
    with pytest.raises(KernelError, match=r"^result 1 of a kernel is not XLA's: 1 instead of 0 in"):
        fuse(lambda x: (x > x - 1, x > x + 1))(np.float32(1))


def test_what_the_function_itself_makes_unsteady_is_not_called_wrong():
    # Neighbouring numbers have other sines, signs and places.
    fuse(lambda x: (jnp.sin(1e6 * x), jnp.sign(x - 1e-8), jnp.argmax(x * 0 + 1)))(states()[0])


def test_explain_tells_what_a_kernel_is(capsys):
    onekernel.explain(fuse(lorenz), jax.ShapeDtypeStruct((3,), np.float32))
    out = capsys.readouterr().out
    assert out.startswith("lorenz is one kernel\n")
    found = dict(re.findall(r"^  (\S.*?)  +(.*)$", out, re.MULTILINE))
    # σ (y - x), x (ρ - z) - y and x y - β z
    assert found["operations"] == "8"
    assert found["reads"] == "12 bytes an instance"
    assert found["writes"] == "12 bytes an instance"
    assert re.fullmatch(
        r"\d+ times stored, \d+ times loaded|\d+ bytes of memory a thread", found["spilled"]
    )
    assert set(found) == {
        *("operations", "reads", "writes", "traced and lowered in", "compiled in"),
        *("registers", "spilled"),
    }


def test_explain_takes_numbers_of_numpy_as_a_call_does(capsys):
    onekernel.explain(lorenz, np.ones(3), rho=np.float64(20))
    assert capsys.readouterr().out.startswith("lorenz is one kernel\n")


@pytest.mark.parametrize("wrong", [3, "raise"])
def test_what_is_no_function_is_refused(wrong):
    with pytest.raises(TypeError, match=f"^fuse takes a function, not {wrong!r}$"):
        fuse(wrong)


def test_an_effect_is_told_with_its_line():
    def shown(x):
        return jax.lax.fori_loop(0, 3, lambda _, y: (jax.debug.print("{}", y), 2 * y)[1], x)

    with pytest.raises(UnsupportedError, match=r"^an effect: Debug \(.*test_fuse.py:\d+.*\)$"):
        fuse(shown, on_unsupported="raise")(1.0)


def test_explain_tells_what_stands_in_the_way(capsys):
    onekernel.explain(spectrum, np.ones(4, np.float32))
    out = capsys.readouterr().out
    line = r"spectrum is no kernel: one kernel cannot do the operation fft \(.*test_fuse.py:\d+"
    assert re.match(line, out)


def test_a_counted_loop_carries_a_random_key_through_a_branch():
    def walk(x, key):
        def move(_, state):
            x, key = state
            key, drawn = jax.random.split(key)
            step = jax.random.normal(drawn)
            return jax.lax.cond(x > 1.0, lambda: x - 0.5 * step, lambda: x + step), key

        return jax.lax.fori_loop(0, 40, move, (x, key))

    x, keys = jnp.zeros(16), jax.random.split(jax.random.key(3), 16)
    ours, ours_keys = jax.vmap(fuse(walk, on_unsupported="raise"))(x, keys)
    theirs, their_keys = jax.jit(jax.vmap(walk))(x, keys)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(*map(jax.random.key_data, (ours_keys, their_keys)))


def test_jax_exports_the_function_itself_and_says_that_it_cannot_export_a_kernel():
    @fuse
    def wave(x):
        return jnp.sin(x) * 2.0

    def exported(function, **options):
        return jax.export.export(jax.jit(jax.vmap(function)), **options)(like)

    x = jnp.linspace(-1.0, 1.0, 5)
    like = jax.ShapeDtypeStruct(x.shape, x.dtype)
    # A kernel of a CPU is machine code in this process: what JAX stores would not contain it.
    with pytest.raises(ValueError, match="custom calls whose targets have no compatibility") as no:
        exported(wave)
    stored = exported(wave.__wrapped__).serialize()
    np.testing.assert_allclose(jax.export.deserialize(stored).call(x), jax.vmap(wave)(x), rtol=1e-6)
    # Who insists gets a program for this process.
    name = re.search(r"@([^(]+)\(", str(no.value))[1]
    check = jax.export.DisabledSafetyCheck.custom_call(name)
    again = jax.export.deserialize(exported(wave, disabled_checks=[check]).serialize())
    np.testing.assert_array_equal(again.call(x), jax.jit(jax.vmap(wave))(x))
