"""Prepare the process of a command: every trick that makes it start sooner, in one place.

Only commands use this package. A program that imports the library keeps its process as it is: the
modules of `jetbot_mjx` and `onekernel` change nothing in it when they are imported.

`JETBOT_MJX_PLAIN_START=1` turns all of these off, to find out whether one of them is to blame for
an error. A command then does the same, but it starts later, a GPU's memory is allocated at once,
and Ctrl-C may wait for a compiler or print a traceback during imports:

    trick                  what it does, and what it saves of a start (tested with)
    ---------------------  -----------------------------------------------------------------------
    collect_garbage_late   raises the thresholds of Python's garbage collector for a minute:
                           220 ms (Python 3.11, 3.13)
    set_environment        OPENBLAS_NUM_THREADS=1, so that NumPy starts no threads;
                           PYDANTIC_DISABLE_PLUGINS, so that Pydantic looks for none
                           (NumPy 2.4, Pydantic 2.13)
    install_lazy_imports   imports parts of Flax (180 ms), JAX (Pallas, 60 ms), Brax, MJX, MuJoCo
                           and tensorboardX (PyTorch, seconds) at their first use, or not at all
                           (JAX 0.10, 0.12; Flax 0.12; MuJoCo 3.17; tensorboardX 2.6)
    exit_at_once           ends the process without Python's clean-up: 1 s on a GPU (JAX 0.10)
    wake_driver            opens NVIDIA's driver in a thread while JAX is imported: 190 ms
                           (CUDA 13)
    wake_device            initialises JAX's device in a thread while the rest is imported, and
                           lets JAX allocate GPU memory as needed: 2 s (JAX 0.10, 0.12)
    load_blas              loads the libraries for matrix products on a GPU while the programs are
                           traced, if they must be compiled: 500 ms (JAX 0.10)
    enable_jax_cache       turns JAX's compilation cache on: all of a second compilation
                           (JAX 0.10, 0.12)
    exit_on_interrupt      lets Ctrl-C end a command that still imports, without a traceback
                           (Python 3.11, 3.13)
    repeat_interrupts      raises Ctrl-C again where Python has printed and ignored it
    exit_if_stuck          lets Ctrl-C end a command that a compiler keeps busy

The others here (`protect_output`, `keep_own_files`, `share_memory`, `divide_cpu`) carry out what a
command promises and a setting requests; they save no time, and are always on.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
