"""Kernels for NVIDIA GPUs, launched as on one, and run by a model of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import simt
from helpers.kernel_cases import FUNCTIONS, SCANS, VECTOR, robots
from helpers.map_kernels import make, reference
from helpers.map_kernels import robots as of_map
from onekernel import gpu
from onekernel.gpu.kernel_text import kernel_text
from onekernel.kernel import Kernel
from onekernel.lower.jaxpr import scalarize


@pytest.fixture
def model(monkeypatch):
    simt.replace_gpu(monkeypatch)
    return monkeypatch


def expected(function, *leaves):
    with jax.default_matmul_precision("highest"):
        return jax.jit(jax.vmap(function))(*leaves)


@pytest.mark.parametrize("name", {**FUNCTIONS, **SCANS})
def test_a_kernel_does_what_the_function_does(name, model):
    function = {**FUNCTIONS, **SCANS}[name]
    kernel = Kernel(scalarize(function, VECTOR), carried=1, steps=1, fallback=None)
    x = robots(70)
    (ours,) = gpu.launch(kernel, [x])
    np.testing.assert_allclose(ours, expected(function, x), rtol=2e-5, atol=2e-6)


def walk(x, force):
    """A step with a loop and a branch, whose lengths differ from robot to robot."""
    y = jax.lax.while_loop(
        lambda s: (s[1] < x[0] * 4) & (s[1] < 9), lambda s: (s[0] * 0.5 + force, s[1] + 1), (x, 0.0)
    )[0]
    return jax.lax.cond(y[1] > 0, lambda y: jnp.sqrt(jnp.abs(y)) - 0.5, lambda y: y + 0.25, y)


def begin(x, force):
    return x * 2.0, force - 0.5


def end(x, force, last):
    return last + x, jnp.sum(last * force)


PARTS = {"plain": (None, None), "with a beginning and an end": (begin, end)}


def steps(x, force, parts, count):
    before, after = parts
    now, held = before(x, force) if before else (x, force)
    for _ in range(count):
        now = walk(now, held)
    return after(x, force, now) if after else (now,)


@pytest.mark.parametrize("shares", [False, True])
@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("instances", [1, 64, 100])
def test_several_steps_are_those_of_the_function(instances, parts, shares, model):
    model.setattr(gpu, "_DIRECT_WORDS", 0 if shares else 99)
    model.setattr(gpu, "_BLOCKS", 1)
    before, after = PARTS[parts]
    kernel = Kernel(
        scalarize(walk, VECTOR, VECTOR),
        carried=1,
        steps=3,
        fallback=None,
        before=before and scalarize(before, VECTOR, VECTOR),
        after=after and scalarize(after, VECTOR, VECTOR, VECTOR),
    )
    x, force = robots(instances), robots(instances)[::-1].copy()
    ours = gpu.launch(kernel, [x, force])
    theirs = expected(lambda *leaves: steps(*leaves, PARTS[parts], 3), x, force)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("missing", [None, "fetch", "steps", "release", "deliver"])
def test_rows_by_way_of_shared_memory_need_the_barriers_that_the_text_has(missing):
    kernel = Kernel(
        scalarize(walk, VECTOR, VECTOR),
        carried=1,
        steps=2,
        fallback=None,
        after=scalarize(end, VECTOR, VECTOR, VECTOR),
    )
    text = kernel_text(kernel, shares=True).replace("INSTANCES", "64")
    parts = text.split("call void @llvm.nvvm.barrier0()")
    barriers = ["fetch", "steps", "release", "deliver"]
    text = parts[0]
    for name, part in zip(barriers, parts[1:], strict=True):
        text += part if name == missing else "call void @llvm.nvvm.barrier0()" + part
    arrays = [robots(64), robots(64), np.zeros((64, 4), np.float32), np.zeros(64, np.float32)]
    # That of the steps is there for their speed.
    if missing in (None, "steps"):
        simt.run(text, arrays, threads=64, shared_memory=4 * 64 * 8)
    else:
        with pytest.raises(simt.Fault, match="a race: another thread"):
            simt.run(text, arrays, threads=64, shared_memory=4 * 64 * 8)


@pytest.mark.parametrize("items", [64, 100, 300])
def test_the_bytes_of_a_map_are_those_of_the_function(items, model):
    table, kernel = make(items)
    leaves = of_map(3)
    (ours,) = gpu.launch(kernel, [*leaves, table])
    theirs = np.stack([reference(*(x[i] for x in leaves), table) for i in range(3)])
    # Where a number is whole, rounding decides between two bytes.
    assert np.abs(ours.astype(int) - theirs).max() <= 1
    assert (ours == theirs).mean() > 0.99


def damped(x):
    """A loop of its own length for each robot, which reads a vector and its multiples."""
    twice, half = x + x, x * 0.5

    def again(s):
        y, count = s
        return (y * half - x) * twice, count + 1

    return jax.lax.while_loop(lambda s: s[1] < x[0], again, (x * x, 0.0))[0]


def test_a_loop_computes_again_what_follows_from_its_other_values(model):
    kernel = Kernel(scalarize(damped, VECTOR), carried=1, steps=1, fallback=None)
    # Twice and half of each number, in the loop; LLVM does not move them out again.
    assert kernel_text(kernel).count('"mov.f32 $0, $1;"') == 2 * VECTOR.shape[0]
    x = robots(70)
    (ours,) = gpu.launch(kernel, [x])
    np.testing.assert_allclose(ours, expected(damped, x), rtol=2e-5, atol=2e-6)
