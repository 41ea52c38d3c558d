"""What each test costs in processor time, told at the end of a run: by room, and the dearest tests.

Processor time, with that of the processes that a test started and waited for, is nearly the same
on a busy machine as on an idle one. A fixture's time is that of the first test that asks for it.
"""

import collections
import resource
import time
from pathlib import Path

import pytest

LIMIT = 40
"""Processor time of `make test` in a clean clone, at most [min]; CONTRIBUTING.md promises it."""

SHOWN = 25
"""Tests that are named."""

_LEAST = 0.5
"""Tests that cost less are not named [s]."""


def cpu_seconds():
    """Processor time of this process and of those that it waited for [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


_last = 0.0


def pytest_runtest_logstart():
    """Begin to count with the first test: not what collecting them has cost."""
    global _last
    _last = cpu_seconds()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Keep with each report what the process has cost since the one before."""
    global _last
    report = yield
    report.cpu_seconds, _last = cpu_seconds() - _last, cpu_seconds()
    return report


_costs = collections.Counter()


def pytest_runtest_logreport(report):
    """Add the cost of setting a test up, running it or tearing it down."""
    _costs[report.nodeid] += getattr(report, "cpu_seconds", 0.0)  # that of a crash has none


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session, exitstatus):
    """Let a run fail that took longer than is promised."""
    if exitstatus == pytest.ExitCode.OK and too_long(session.config.option.markexpr):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def too_long(marks):
    """Whether `make test`, which selects tests by these marks, took longer than is promised."""
    return marks == "not slow" and _costs.total() > 60 * LIMIT


def pytest_terminal_summary(terminalreporter, config):
    """Print the costs of this run."""
    if _costs:
        terminalreporter.section("processor time [s]")
        for line in summary(_costs):
            terminalreporter.write_line(line)
    if too_long(config.option.markexpr):
        terminalreporter.write_line(f"error: the tests take more than {LIMIT} min", red=True)


def summary(costs):
    """Lines that tell the costs of tests, by their names, summed over the folders of `tests/`."""
    rooms = collections.Counter()
    for test, seconds in costs.items():
        rooms[Path(test.partition("::")[0]).with_suffix("").parts[1]] += seconds
    for room, seconds in [("all", sum(costs.values())), *rooms.most_common()]:
        yield f"{seconds:8.1f}  {room}"
    yield ""
    for test, seconds in costs.most_common(SHOWN):
        if seconds >= _LEAST:
            yield f"{seconds:8.1f}  {test}"
