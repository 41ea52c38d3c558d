"""The example that introduces the engine runs as it is written, in a process of its own."""

import re
import subprocess
import sys
import textwrap

import pytest

import onekernel
from onekernel import cpu

EXAMPLE = textwrap.dedent(re.search(r"\n((?:    .*\n|\n)+)\nA `Kernel`", onekernel.__doc__)[1])

BY_HAND = """
import jax, jax.numpy as jnp
from onekernel import Kernel
from onekernel.build import scalarize
step = lambda state, control: state + 0.5 * control
shape = jax.ShapeDtypeStruct((3,), jnp.float32)
program = scalarize(step, shape, shape)
kernel = Kernel(program, carried=1, steps=4, fallback=lambda s, c: [s + 2 * c])
states = jax.vmap(kernel.as_step())(jnp.zeros((5, 3)), jnp.ones((5, 3)))
"""


@pytest.mark.parametrize(("program", "number"), [(EXAMPLE, 0.1), (BY_HAND, 2.0)])
def test_it_runs(program, number):
    ending = (
        "\nprint(states.shape[1], float(states.max()), 'jetbot_mjx' in __import__('sys').modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program + ending], capture_output=True, text=True, check=True
    )
    columns, found, others = done.stdout.split()
    assert (columns, float(found), others) == ("3", pytest.approx(number), "False")


@pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels here")
@pytest.mark.cpu
def test_it_is_one_kernel():
    assert "kernel" in EXAMPLE
    lowered = EXAMPLE.replace("(jnp.zeros", ".lower(jnp.zeros", 1) + "print(states.as_text())"
    done = subprocess.run(
        [sys.executable, "-c", lowered], capture_output=True, text=True, check=True
    )
    assert done.stdout.count("custom_call @onekernel_") == 1
