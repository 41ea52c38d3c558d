"""Compile a JAX function of one robot into one kernel that steps all robots.

`lower_jaxpr` lowers the function to operations on scalars (`scalar_ir`, `indexing`), `schedule`
orders them, and `llvm_codegen` writes them as LLVM IR. `llvm_backend` compiles that IR for CPUs and
`ptx_backend` for NVIDIA GPUs; `kernel` wraps both as one JAX primitive. `random_bits` has JAX's
random bits as such a kernel, and `update` the gradient of PPO's loss. `program_cache` caches whole
compiled programs from one process to the next. This package knows nothing of robots.
"""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.compiler.program_cache import ProgramCache as ProgramCache

__getattr__, __dir__ = load_lazily(__name__)
