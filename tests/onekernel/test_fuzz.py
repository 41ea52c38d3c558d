"""Random functions through every step of the kernel compiler, against XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import call_frame, random_functions
from helpers.further import slow_unless
from helpers.random_terms import DTYPES, mixed_dtypes
from helpers.run_program import evaluate
from onekernel import cpu, fuse, gpu
from onekernel.check import differ
from onekernel.cpu import xla_call
from onekernel.lower import control_flow
from onekernel.round_off import noisy

if cpu.obstacle():
    pytest.skip("llvmlite compiles nothing here", allow_module_level=True)

QUICK = 4
BATCH = 24  # functions in one test of the slow suite
BATCHES = 100
REGRESSIONS = (33, 62, 110, 236, 689, 972)
"""Seeds of functions that once had no kernel, or of which XLA has two results."""

STAGES = 5
"""Of so many functions one is also checked in each stage of the compiler."""

AMPLIFICATION = 8.0
"""Multiple of what the shaking changes that a result may differ by."""

SHAKES = 6
SHAKE_UNITS = 2
"""Largest change of a number that is shaken, in units of the last place of 1."""

LANES = cpu.host_processor().lanes
_engines = []


def compiled(function):
    """Return a program as XLA compiles it soonest."""
    options = {}
    if jax.default_backend() == "cpu":
        options = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    return jax.jit(function, compiler_options=options)


def by_xla(function, arguments, seed, *, batched):
    """Return the results that XLA computes, and others whose inexact numbers are shaken.

    Which operations a function enlarges the round-off of is measured so, not assumed: a number may
    differ by a few times what it differs by where all inexact ones change in their last bits.
    """

    def one_by_one(x, shake):
        return jax.lax.map(lambda one: function(one, shake), x)

    run = compiled(jax.vmap(function, in_axes=(0, None)) if batched else one_by_one)
    rng, dtype = np.random.default_rng(seed), np.dtype(function.dtypes["f"])
    shakes = rng.uniform(-1, 1, (SHAKES, function.shakes)).astype(dtype)
    shakes *= SHAKE_UNITS * np.finfo(dtype).eps
    plain, *shaken = (words(run(arguments, x)) for x in [np.zeros_like(shakes[0]), *shakes])
    return plain, shaken


def words(tree):
    """Return a tree of NumPy arrays, with the words of random keys."""

    def array(x):
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    return jax.tree.map(array, tree)


def agree(function, ours, theirs, shaken, what):
    """Check that results are XLA's: exact ones to the last bit, others but for round-off."""
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    exact = jax.tree.leaves(function.is_exact)
    columns = [jax.tree.leaves(x) for x in (ours, theirs, *shaken)]
    for place, (is_exact, one, other, *shakes) in enumerate(zip(exact, *columns, strict=True)):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        assert is_exact or np.isfinite(other).all()
        if is_exact:
            wrong = np.argwhere(one != other)
        else:
            largest = np.abs(other).max(axis=0)
            wrong = np.argwhere(differ(one, other, shakes, AMPLIFICATION, largest))
        assert not len(wrong), (
            f"{what}: leaf {place} at {wrong[0]} is {one[(*wrong[0],)]}, not {other[(*wrong[0],)]}"
        )


def agree_all(function, results, theirs, shaken):
    """Check several results of one function, by what computed them."""
    for what, ours in results.items():
        agree(function, ours, theirs, shaken, what)


def by_noise(kernel, arguments, like, seed):
    """Return results with noise in every operation of a kernel's function."""
    leaves = jax.tree.leaves(words(arguments))
    passed = [x.astype(np.float32) if x.dtype == bool else x for x in leaves]
    run = compiled(jax.vmap(noisy(kernel.fallback)))
    seeds = np.random.default_rng(seed).integers(1, 2**32, (SHAKES, len(passed[0])), np.uint32)
    return [received(map(np.asarray, run(one, *passed)), like) for one in seeds]


def by_stages(kernel, leaves, seed):
    """Yield the results of a kernel as NumPy, a vector register and a thread compute them."""
    program = kernel.program
    passed = [x.astype(np.float32) if x.dtype == bool else as_words(x) for x in leaves]
    yield "in NumPy", [np.asarray(x, np.float32) for x in evaluate(program, passed)]
    for lanes in (LANES, 1):
        text = xla_call.kernel_text(kernel, lanes=lanes, machine=cpu.host_processor().machine)
        _engines.append(cpu._load(cpu._compile(text)))
        handler = call_frame.Handler(_engines[-1].get_function_address(cpu.NAME))
        results = [np.zeros((len(passed[0]), *x.shape), np.float32) for x in program.outputs]
        assert call_frame.call(handler, passed, results) is None
        yield f"{lanes} lanes", results
    assert "onekernel" in gpu.compiled(kernel, gpu._ARCHITECTURES[seed % 3])


def received(results, like):
    """Return what a kernel returned, as arrays like others."""
    leaves, structure = jax.tree.flatten(like)
    pairs = zip(results, leaves, strict=True)
    return structure.unflatten(
        [x != 0 if y.dtype == bool else x.view(y.dtype).reshape(y.shape) for x, y in pairs]
    )


def as_words(x):
    """Return numbers as a kernel reads them: float32, two along a last axis for one of 64 bits."""
    return x.view(np.float32) if x.itemsize == 4 else x[..., None].view(np.float32)


def compare(function, seed, monkeypatch, *, stages):
    """Check a random function, with the arguments of a seed."""
    arguments = random_functions.inputs(seed, 2 * LANES + 3, function.dtypes)
    fused = fuse(function, on_unsupported="raise")
    with monkeypatch.context() as patch:
        if seed % 2:
            # Loops and branches where there would be none: all are small here.
            patch.setattr(control_flow, "MIN_BRANCH_OPERATIONS", 2)
            patch.setattr(control_flow, "MAX_UNROLLED_OPERATIONS", 8)
        ours = words(compiled(jax.vmap(fused))(arguments))
        kernel = fused.lowered(*jax.tree.map(lambda x: x[0], (arguments,))).one
    results = {"fused": ours}
    theirs, shaken = by_xla(function, arguments, seed, batched=False)
    if stages:
        made = by_stages(kernel, jax.tree.leaves(words(arguments)), seed)
        results |= {what: received(one, theirs) for what, one in made}
    try:
        agree_all(function, results, theirs, shaken)
    except AssertionError:
        # On CPUs XLA writes a part of an array over the array itself while it still reads it, if
        # the place is not one of a batch; and its own results change with how it is told to
        # compile, by more than a shaken number does. Both take longer to find out.
        theirs, shaken = by_xla(function, arguments, seed, batched=True)
        shaken += by_noise(kernel, arguments, theirs, seed)
        agree_all(function, results, theirs, shaken)


def check(seed, monkeypatch, *, stages, is_wide=False):
    """Check the function of a seed; a failure tells as few of its lines as fail in this way.

    Args:
      seed: the seed.
      monkeypatch: what the compiler's limits are changed with.
      stages: whether each stage of the compiler is checked, too.
      is_wide: whether some dtypes have 64 bits.

    Raises:
      AssertionError: a result is not XLA's, or a function cannot be compared.
    """

    def failure(function):
        try:
            with jax.enable_x64(is_wide):
                compare(function, seed, monkeypatch, stages=stages)
        except Exception as error:
            return error
        return None

    dtypes = mixed_dtypes(seed) if is_wide else DTYPES
    with jax.enable_x64(is_wide):
        function = random_functions.RandomFunction(seed, dtypes=dtypes)
    if error := failure(function):
        for name in reversed(function.lines):
            smaller = function.without(name)
            if type(found := failure(smaller)) is type(error):
                function, error = smaller, found
        raise AssertionError(f"seed {seed}: {error}\n{function.text}") from error


@pytest.mark.parametrize(
    "seed", slow_unless(range(QUICK).__contains__, [*range(QUICK), *REGRESSIONS])
)
def test_a_function_is_what_jax_makes_of_it(seed, monkeypatch):
    check(seed, monkeypatch, stages=seed % STAGES == 0)


@pytest.mark.parametrize("seed", slow_unless(range(QUICK).__contains__, range(BATCH)))
def test_a_function_of_numbers_of_64_bits_is_what_jax_makes_of_it(seed, monkeypatch):
    check(seed, monkeypatch, stages=seed % STAGES == 0, is_wide=True)


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(BATCHES))
def test_thousands_of_functions_of_64_bits_are_what_jax_makes_of_them(batch, monkeypatch):
    for seed in range(BATCH * (batch + 1), BATCH * (batch + 2)):
        check(seed, monkeypatch, stages=seed % STAGES == 0, is_wide=True)


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(BATCHES))
def test_thousands_of_functions_are_what_jax_makes_of_them(batch, monkeypatch):
    for seed in range(QUICK + BATCH * batch, QUICK + BATCH * (batch + 1)):
        check(seed, monkeypatch, stages=seed % STAGES == 0)
