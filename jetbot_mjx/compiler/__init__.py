"""Compile a JAX function of one robot into one kernel that steps all robots.

`lower_jaxpr` takes the function apart into operations on single numbers (`scalar_ir`, `indexing`),
`schedule` orders them, and `llvm_codegen` writes them as LLVM's text. `llvm_backend` compiles that
text for CPUs and `ptx_backend` for NVIDIA GPUs; `kernel` makes a JAX primitive of both.
`program_cache` keeps whole compiled programs from one process to the next. Nothing here knows of
robots.
"""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.compiler.program_cache import ProgramCache as ProgramCache

__getattr__, __dir__ = load_lazily(
    __name__,
    {
        "ProgramCache": "program_cache",
    },
)
