"""Compile a JAX function of one instance into one kernel that runs it for all instances.

    import jax
    import jax.numpy as jnp
    import onekernel

    def step(state, control):  # one instance
        return jnp.sin(state) + 0.1 * control

    step = onekernel.fuse(step)  # the same function, as one kernel where that can be
    states = jax.jit(jax.vmap(step))(jnp.zeros((4096, 3)), jnp.ones((4096, 3)))

A `Kernel` is made by hand where more is known: how often a step is repeated inside the kernel,
that all numbers are finite (`scalarize` assumes it, so that 0·x is 0), what to run where there is
no back end (`fallback`, a function of flat arguments to flat results that makes all steps), or that
the function is computed for each column of a table, such as the pixels of an image
(`Kernel.as_map`).

The parts, each of which imports only from those before it:

- `lower`: a jaxpr to operations on scalars, placed in blocks
- `codegen`: these blocks to LLVM IR
- `kernel`: a kernel as a JAX primitive; `errors`: what it raises
- `cpu`, `gpu`: machine code and PTX, and who launches it; `backends`: both
- `fused`: a function of one instance as one kernel, with another kernel inside
- `check`, `explanation`: whether a kernel computes what XLA does, and what the compiler made of it
- `aot`: compiled programs from one process to the next

`onekernel.build` has what one needs to write a kernel around a lowered function.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
