"""What is computed in a thread that nobody waits for."""

import contextvars
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
