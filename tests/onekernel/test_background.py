"""What is computed in a thread that nobody waits for."""

import contextvars
import sys
import threading

import pytest

from onekernel.background import in_background

NAME = contextvars.ContextVar("NAME")


def test_the_result_is_that_of_a_thread_with_the_callers_context():
    NAME.set("caller")
    name, thread = in_background(lambda: (NAME.get(), threading.current_thread())).result()
    assert name == "caller"
    assert thread is not threading.main_thread()
    assert thread.daemon


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt(), SystemExit(3)])
def test_an_error_is_raised_where_the_result_is_asked_for(error):
    def fail():
        raise error

    future = in_background(fail)
    with pytest.raises(type(error)) as caught:
        future.result()
    assert caught.value is error


@pytest.mark.skipif(sys.platform != "linux", reason="counts the page faults of one thread")
def test_no_depth_of_calls_makes_every_call_ask_for_memory():
    def leaf():
        return None

    resource = pytest.importorskip("resource")

    def faults_at(depth):
        if depth:
            return faults_at(depth - 1)
        before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
        for _ in range(1000):
            leaf()
        return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before

    # The end of Python's first piece of 16 KiB, and of its second, lies at one of these depths.
    faults = in_background(lambda: [faults_at(depth) for depth in range(50, 400)]).result()
    assert max(faults) < 500
