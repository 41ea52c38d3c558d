"""Compile a JAX function of one instance into one kernel that runs it for all instances.

    import jax
    import jax.numpy as jnp
    import onekernel

    def step(state, control):  # one instance
        return jnp.sin(state) + 0.1 * control

    step = onekernel.fuse(step)  # the same function, as one kernel where that can be
    states = jax.jit(jax.vmap(step))(jnp.zeros((4096, 3)), jnp.ones((4096, 3)))

A `Kernel` that you make yourself can say more: how often a step is repeated inside the kernel, that
all numbers are finite (`scalarize` assumes it, so that 0·x is 0), which function runs where there
is no back end (`fallback`, from flat arguments to flat results, all steps), or that the function is
computed for each column of a table, such as the pixels of an image (`Kernel.as_map`).

The way of `x * c + 1.0` through the package, with an x of two numbers and a scalar c:

    JAX's jaxpr                scalars in the graph       LLVM IR, 8 instances in a vector
    c:f32[2] = mul a b         3 = mul 0 2                %v7 = fmul contract <8 x float> %v2, %v6
                               4 = mul 1 2                %v8 = fmul contract <8 x float> %v4, %v6
    d:f32[2] = add c 1.0       5 = add 3 1.0              %v9 = fadd contract <8 x float> %v7, ...
                               6 = add 4 1.0              %v10 = fadd contract <8 x float> %v8, ...

The scalars 0 and 1 are x, and 2 is c. On a GPU a thread computes one instance, with `float` where a
CPU has `<8 x float>`. Around these instructions, a kernel loads arguments and stores results.

The parts, each of which imports only from those before it:

- `lower`: a jaxpr to operations on scalars, placed in blocks
- `codegen`: these blocks to LLVM IR
- `kernel`: a kernel as a JAX primitive; `keys`: random keys as words; `errors`: what it raises
- `fingerprint`: a hash of a traced function and the kernels in it
- `cpu`, `gpu`: these to machine code and PTX, and its launch by XLA; `backends`: both
- `wasm`: these to WebAssembly, whose functions a web page calls
- `check`: a kernel's results beside XLA's
- `derivatives`: what JAX differentiates, as a kernel forward and one backward
- `traced`: a traced function as one kernel, with another kernel inside
- `fused`: a function of one instance, which is traced and launched as one kernel
- `explanation`: what the compiler made of it
- `aot`: compiled programs from one process to the next
- `optimum`: the derivative of what MJX's constraint solver finds
- `mujoco`: the step of a MuJoCo model (`fuse_mjx`); no part before these two needs MuJoCo

`onekernel.build` exports the functions with which to write a kernel around a lowered function.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
