"""Write kernels around a lowered function, as LLVM IR that the back ends compile and launch."""

from onekernel import cpu, gpu, wasm
from onekernel.backends import BACKENDS
from onekernel.background import in_background
from onekernel.codegen import LlvmWriter, Repeat, Value, run_program
from onekernel.fingerprint import fingerprint
from onekernel.kernel import Backend, make_primitive
from onekernel.lower import (
    ScalarProgram,
    evaluate,
    scalarize,
    unroll_linear_algebra,
)

__all__ = [
    "BACKENDS",
    "Backend",
    "LlvmWriter",
    "Repeat",
    "ScalarProgram",
    "Value",
    "cpu",
    "evaluate",
    "fingerprint",
    "gpu",
    "in_background",
    "make_primitive",
    "run_program",
    "scalarize",
    "unroll_linear_algebra",
    "wasm",
]
