"""XLA's side of a call of a kernel on a CPU, in ctypes: frames as the C header has them."""

import ctypes
import threading

import numpy as np


class Buffer(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    ]


class Buffers(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(Buffer))),
    ]


class Attributes(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("rest", ctypes.c_void_p * 3),
    ]


class Version(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    ]


class Metadata(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("version", Version),
        ("traits", ctypes.c_uint32),
        ("state_type", ctypes.c_int64),
    ]


class MetadataExtension(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("kind", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(Metadata)),
    ]


class Api(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", Version),
        ("internal", ctypes.c_void_p),
        ("error_create", ctypes.c_void_p),
        ("error_message", ctypes.c_void_p),
        ("error_destroy", ctypes.c_void_p),
        ("others", ctypes.c_void_p * 8),
        ("schedule", ctypes.c_void_p),
        ("thread_count", ctypes.c_void_p),
    ]


class Frame(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("api", ctypes.POINTER(Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", Buffers),
        ("results", Buffers),
        ("attributes", Attributes),
        ("future", ctypes.c_void_p),
    ]


FRAME_SIZE = Frame.future.offset

Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
Task = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_ApiFunction = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t * 5))


class Pool:
    """Threads of XLA's; `refuses` answers a task with an error, `waits` runs it after the call.

    `left` are the results as the call leaves them.
    """

    def __init__(self, threads=1, refuses=False, waits=False):
        self.threads, self.refuses, self.waits = threads, refuses, waits
        self.scheduled, self.destroyed, self.started = [], [], []

    def schedule(self, arguments):
        _, _, _, task, data = arguments.contents
        self.scheduled.append((task, data))
        if self.refuses:
            return 0xBAD
        if not self.waits:
            thread = threading.Thread(target=Task(task), args=(data,))
            thread.start()
            self.started.append(thread)
        return None

    def count(self, arguments):
        ctypes.c_int64.from_address(arguments.contents[3]).value = self.threads

    def destroy(self, arguments):
        self.destroyed.append(arguments.contents[2])

    def finish(self):
        for thread in self.started:
            thread.join()
        for task, data in self.scheduled if self.waits else []:
            Task(task)(data)


def call(handler, arguments, results, pool=None, change=None):
    """Calls a kernel as XLA does; `change` may spoil the frame before."""
    pool = pool or Pool()
    functions = [_ApiFunction(f) for f in (pool.schedule, pool.count, pool.destroy)]
    addresses = [ctypes.cast(function, ctypes.c_void_p).value for function in functions]
    api = Api(ctypes.sizeof(Api), version=Version(24, None, 0, 3))
    api.schedule, api.thread_count, api.error_destroy = addresses
    frame = Frame(FRAME_SIZE, api=ctypes.pointer(api), stage=3)
    frame.arguments, frame.results = _buffers(arguments), _buffers(results)
    if change is not None:
        change(frame)
    error = handler(ctypes.addressof(frame))
    pool.left = [array.copy() for array in results]
    pool.finish()
    return error


def ask_metadata(handler):
    """Asks a kernel for the version of the interface that it was written for."""
    metadata = Metadata(ctypes.sizeof(Metadata))
    extension = MetadataExtension(32, 1, None, ctypes.pointer(metadata))
    frame = Frame(FRAME_SIZE, extension=ctypes.addressof(extension))
    assert handler(ctypes.addressof(frame)) is None
    return metadata.version.major, metadata.version.minor


def _buffers(arrays):
    pointers = (ctypes.POINTER(Buffer) * len(arrays))()
    for i, array in enumerate(arrays):
        assert array.dtype == np.float32
        assert array.flags.c_contiguous
        dims = (ctypes.c_int64 * array.ndim)(*array.shape)
        data = array.ctypes.data
        pointers[i] = ctypes.pointer(Buffer(48, None, 11, data, array.ndim, dims))
    return Buffers(40, None, len(arrays), None, pointers)
