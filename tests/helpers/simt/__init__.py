"""Run the text of a GPU's kernel in NumPy, and raise an error for races and bad addresses.

The model: the blocks of the grid run one after the other. A register is an array over the threads
of a block, and all threads that wait at one place of the text run on together, up to the end of the
basic block or to a barrier. Of several such places, the one that stands first in the text is next:
so threads that part at a branch or in a loop meet again behind it.

A `Fault` is raised for

- an address outside of an array, of shared or of the thread's own memory, or misaligned;
- a barrier, or an instruction of a whole warp, that only a part of a warp comes to, and a barrier
  that some of its threads never reach;
- a race: two threads of a block access a word, one of them to change it, with no barrier that both
  pass in between, or threads of two blocks do;
- a float converted to an integer that cannot hold it.

Instructions that it does not know raise `NotImplementedError`. Approximate ones are computed in
float64 and rounded. Not modelled: time, caches, the order in which memory changes, and registers.
"""

import numpy as np

from helpers.simt.block import Block
from helpers.simt.memory import WARP, Fault, Memory
from helpers.simt.program import parsed
from onekernel import gpu

__all__ = ["Fault", "replace_gpu", "run"]


def run(text, arrays, grid=(1, 1, 1), threads=None, shared_memory=0):
    """Run a kernel.

    Args:
      text: a module of LLVM IR with one kernel.
      arrays: the arrays that its parameters point to, which it may change; one may be given twice.
      grid: the number of blocks along each axis.
      threads: the number of threads of a block; None: the most that the kernel may have.
      shared_memory: dynamic shared memory of a block [bytes].

    Raises:
      Fault: see the module.
      NotImplementedError: the model does not know an instruction.
    """
    program = parsed(text)
    threads = threads or program.threads
    assert threads % WARP == 0
    assert threads <= program.threads
    memories = {x.ctypes.data: Memory(x) for x in arrays}
    given = [memories[x.ctypes.data] for x in arrays]
    given += [Memory(words) for words in program.tables.values()]
    for number, place in enumerate(np.ndindex(*grid[::-1])):
        registers = dict(zip(("ctaid.z", "ctaid.y", "ctaid.x"), place, strict=True))
        registers |= {f"nctaid.{axis}": size for axis, size in zip("xyz", grid, strict=True)}
        with np.errstate(all="ignore"):
            Block(program, given, registers, threads, shared_memory).run(number)


def replace_gpu(monkeypatch, capability=90, processors=5):
    """Let launches of kernels on a GPU, outside of JAX's programs, run here instead.

    Args:
      monkeypatch: the fixture.
      capability: ten times the compute capability of the GPU.
      processors: the number of its multiprocessors.
    """

    def launch(name, text, arguments, results, grid, threads, shared_memory=0, aliases=None):
        assert f"void @{name}(" in text
        given = [np.array(x) for x in arguments]
        # What no thread has written is NaN, or the largest byte.
        made = [
            np.full(x.shape, np.nan if x.dtype == np.float32 else 255, x.dtype) for x in results
        ]
        for argument, result in (aliases or {}).items():
            made[result] = given[argument]
        run(text, [*given, *made], grid, threads, shared_memory)
        return made

    monkeypatch.setattr(gpu, "compute_capability", lambda: capability)
    monkeypatch.setattr(gpu, "processor_count", lambda: processors)
    monkeypatch.setattr(gpu, "assembled", lambda text, *_: text)
    monkeypatch.setattr(gpu, "assemble_ahead", lambda text: None)
    monkeypatch.setattr(gpu, "launch_ptx", launch)
