"""Random functions through every step of the kernel compiler, against JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import call_frame, random_functions
from helpers.run_program import evaluate
from onekernel import cpu, gpu
from onekernel.cpu import xla_call
from onekernel.kernel import Kernel
from onekernel.lower import control_flow, scalarize

if cpu.obstacle():
    pytest.skip("llvmlite compiles nothing here", allow_module_level=True)

QUICK = 6
BATCH = 50  # functions in one test of the slow suite
BATCHES = 20

ARGUMENT = jax.ShapeDtypeStruct((random_functions.INPUTS,), jnp.float32)
RESULT = jax.ShapeDtypeStruct((random_functions.RESULTS,), jnp.float32)
_engines = []


def _quick():
    """What lets XLA compile in half the time on a CPU."""
    if jax.default_backend() != "cpu":
        return {}
    return {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def agree(ours, theirs, errors, what):
    assert np.isfinite(theirs).all()
    wrong = np.argwhere(~(np.abs(ours - theirs) <= errors))
    assert not len(wrong), f"{what}: robot and number {wrong[0]}"


def by_llvm(program, lanes, arguments):
    """What a kernel of so many lanes makes of the arguments; one lane is a GPU's thread."""
    text = xla_call.kernel_text(
        Kernel(program, carried=1, steps=1, fallback=list),
        lanes=lanes,
        machine=cpu.host_processor().machine,
    )
    _engines.append(cpu._load(cpu._compile(text)))
    handler = call_frame.Handler(_engines[-1].get_function_address(cpu.NAME))
    result = np.full_like(arguments[0], np.nan)
    assert call_frame.call(handler, arguments, [result]) is None
    return result


def check(seed, monkeypatch):
    function = random_functions.RandomFunction(seed)
    lanes = cpu.host_processor().lanes
    x = random_functions.inputs(seed, 2 * lanes + 3)
    theirs = np.asarray(jax.jit(jax.vmap(function), compiler_options=_quick())(x))
    if seed % 2:
        # Loops and branches where there would be none: all are small here.
        monkeypatch.setattr(control_flow, "MIN_BRANCH_OPERATIONS", 2)
        monkeypatch.setattr(control_flow, "MAX_UNROLLED_OPERATIONS", 8)
    program = scalarize(lambda result, x: function(x), RESULT, ARGUMENT)
    monkeypatch.undo()
    arguments = [np.zeros_like(theirs), x]
    agree(evaluate(program, arguments)[0], theirs, function.errors, "in NumPy")
    for count in (lanes, 1):
        ours = by_llvm(program, count, arguments)
        agree(ours, theirs, function.errors, f"{count} lanes")
    kernel = Kernel(program, carried=1, steps=1, fallback=list, impl="ptx")
    assert "onekernel" in gpu.compiled(kernel, gpu._ARCHITECTURES[seed % 3])
    if not gpu.obstacle():
        ours = np.asarray(jax.jit(jax.vmap(kernel.as_step()))(*arguments))
        agree(ours, theirs, function.errors, "on a GPU")


@pytest.mark.parametrize("seed", range(QUICK))
def test_a_function_is_what_jax_makes_of_it(seed, monkeypatch):
    check(seed, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(BATCHES))
def test_a_thousand_functions_are_what_jax_makes_of_them(batch, monkeypatch):
    for seed in range(QUICK + BATCH * batch, QUICK + BATCH * (batch + 1)):
        check(seed, monkeypatch)
