"""One chunk of memory for the frames of all tests.

Python keeps the frames of its functions in chunks of 16 KiB. It maps a new one when a call does
not fit into the last, and unmaps it when that call returns, so a loop whose calls happen to cross
the end of a chunk pays for both, and for the page faults, each time. Called by
pytest, whose own frames come first, some files spent a seventh of their processor time so. A frame
that is larger than a chunk gets a chunk of its own, of a power of two, and the calls above it share
what it leaves.
"""

import pytest

SLOTS = 1 << 17
"""Pointers that the large frame has room for: one mebibyte, of a chunk of two."""


def call(function, **arguments):
    """Call a function from a large frame."""
    return function(**arguments)


call.__code__ = call.__code__.replace(co_stacksize=SLOTS)


class OneChunk:
    """A plugin of pytest that calls the loop over all tests from a large frame."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session):
        loop = session.config.pluginmanager.subset_hook_caller("pytest_runtestloop", [self])
        return call(loop, session=session)
