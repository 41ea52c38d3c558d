"""A kernel with a table: a function of every item of a robot, whose results are bytes."""

import jax
import jax.numpy as jnp
import numpy as np

from onekernel import kernel
from onekernel.lower.jaxpr import scalarize

COLUMNS = 3

ARGUMENTS = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((2,), (), (COLUMNS,))]


def channels(of_robot, number, column):
    """Three values from 0 to 255: one of the robot alone, one of both, one with a branch."""
    own = jnp.sqrt(jnp.abs(of_robot[0])) * 20
    both = jnp.abs(of_robot[1] * column[0] / (column[1] + 1))

    def work(x):
        for _ in range(12):
            x = jnp.abs(jnp.sqrt(x * x + 1.0) * number - 3.0)
        return x

    far = jax.lax.cond(column[2] > 0.5, work, lambda x: x, column[0] * 40)
    return [jnp.clip(x, 0.0, 255.0) for x in (own, both, far)]


def reference(of_robot, number, table):
    values = jax.vmap(channels, in_axes=(None, None, 1))(of_robot, number, jnp.asarray(table))
    return jnp.stack(values, axis=-1).astype(jnp.uint8).reshape(-1)


def make(items, impl="auto"):
    table = np.random.default_rng(items).random((COLUMNS, items), np.float32)
    program = scalarize(channels, *ARGUMENTS)
    return table, kernel.Kernel(
        program,
        carried=0,
        steps=1,
        fallback=lambda *leaves: [reference(*leaves, table)],
        impl=impl,
        table=table,
    )


def robots(count):
    rng = np.random.default_rng(count)
    return rng.normal(0, 5, (count, 2)).astype(np.float32), rng.random(count, np.float32)
