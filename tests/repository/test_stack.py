"""Tests are called from one large frame, and no call of theirs maps memory for its own."""

import resource
import sys

from helpers import stack

CALLS = 100


def test_a_large_frame_calls_all_tests():
    frame, sizes = sys._getframe(), []
    while frame is not None:
        sizes.append(frame.f_code.co_stacksize)
        frame = frame.f_back
    assert sizes.count(stack.SLOTS) == 1


def larger_than_its_caller():
    a = b = c = d = e = f = g = h = 0
    return (a, b, c, d, e, f, g, h)


def faults(depth):
    """Page faults of a loop of calls that begins so many frames from here."""
    if depth:
        return faults(depth - 1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(CALLS):
        larger_than_its_caller()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def test_no_loop_maps_memory_in_each_of_its_calls():
    # So many frames are longer than a chunk of 16 KiB, whose end is thus reached at one of them.
    assert max(faults(depth) for depth in range(300)) < CALLS
