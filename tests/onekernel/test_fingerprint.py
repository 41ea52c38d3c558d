"""The hash of a traced function changes with all that its results depend on, and with no more."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.traced_functions import hashed, program, state_of, step_of
from onekernel import fuse
from onekernel.fingerprint import fingerprint


def test_the_hash_is_the_same_in_another_process(root):
    code = (
        "import helpers.traced_functions as here;"
        " print(here.hashed(here.program), here.hashed(here.step_of(1.0), here.state_of(1.0)))"
    )
    printed = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=root / "tests" / "onekernel",
        env={"PYTHONPATH": f"{root}:{root / 'tests'}", "JAX_PLATFORMS": "cpu", "PATH": ""},
    ).stdout
    assert printed.split() == [hashed(program), hashed(step_of(1.0), state_of(1.0))]


def test_a_kernel_s_model_counts():
    hashes = {hashed(step_of(length), state_of(length)) for length in (1.0, 1.0, 2.0)}
    assert len(hashes) == 2
    assert None not in hashes


@pytest.mark.parametrize(
    "other",
    [
        lambda x: x * 2.0 + 1.5,
        lambda x: x * 2.0 - 1.0,
        lambda x: 1.0 + x * 2.0,
        lambda x: x + 1.0,
        lambda x: (x * 2.0 + 1.0).astype(jnp.int32),
        lambda x: jax.lax.fori_loop(0, 1, lambda i, y: y * 2.0 + 1.0, x),
    ],
)
def test_a_constant_and_an_operation_count(other):
    assert hashed(lambda x: x * 2.0 + 1.0) != hashed(other)


def test_equal_functions_have_equal_hashes():
    assert hashed(lambda x: x * 2.0 + 1.0) == hashed(lambda renamed: renamed * 2.0 + 1.0)


@pytest.mark.parametrize("place", [0, 1234, 4999])
def test_every_number_of_a_large_constant_counts(place):
    # The text of a jaxpr would shorten it.
    one = np.arange(5000, dtype=np.float32)
    other = one.copy()
    other[place] += 1
    assert hashed(lambda x: x.sum() + jnp.asarray(one)) != hashed(
        lambda x: x.sum() + jnp.asarray(other)
    )


def test_a_constant_inside_an_inner_function_counts():
    def of(scale):
        table = jnp.asarray(np.full(7, scale, np.float32))
        return lambda x: jax.jit(lambda x: x.sum() * table)(x)

    assert hashed(of(1.0)) == hashed(of(1.0)) != hashed(of(2.0))


def test_a_kernel_s_operations_count():
    def of(function):
        return hashed(fuse(function, on_unsupported="raise"))

    assert of(lambda x: jnp.sin(x)) == of(lambda x: jnp.sin(x))
    hashes = {of(f) for f in (jnp.sin, jnp.cos, lambda x: jnp.sin(x) + 1, lambda x: jnp.sin(x) + 2)}
    assert len(hashes) == 4


def test_several_functions_have_one_hash_in_their_order():
    one, other = jax.make_jaxpr(jnp.sin)(1.0), jax.make_jaxpr(jnp.cos)(1.0)
    assert len({fingerprint(one, other), fingerprint(other, one), fingerprint(one)}) == 3


def test_a_call_of_python_has_no_hash():
    def calls(x):
        return jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    assert hashed(calls) is None


@pytest.mark.parametrize("wrapped", [lambda function: function, jax.jit])
def test_what_prints_has_no_hash_for_its_program_cannot_be_stored(wrapped):
    def prints(x):
        jax.debug.print("x = {}", x)
        return x

    assert hashed(wrapped(prints)) is None
