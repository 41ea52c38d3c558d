"""Errors about kernels."""

from onekernel.errors import KernelError, UnsupportedError


def test_an_operation_that_cannot_be_lowered_is_told_with_its_place():
    error = UnsupportedError("cannot lower sort")
    assert isinstance(error, KernelError)
    assert error.kind == "operation"
    assert str(error) == "cannot lower sort"
    error.place = "task.py:3"
    assert str(error) == "cannot lower sort (task.py:3)"
