"""What each test costs in processor time, told at the end of a run: by room, and the dearest tests.

Processor time, with that of the processes that a test started and waited for, is nearly the same
on a busy machine as on an idle one. A fixture's time is that of the first test that asks for it.
"""

import collections
import resource
import time
from pathlib import Path

import pytest

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


def pytest_terminal_summary(terminalreporter):
    """Print the costs of this run."""
    costs = collections.Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            # The reports on setting up, running and tearing down; other entries lack `cpu_seconds`.
            if hasattr(report, "cpu_seconds"):
                costs[report.nodeid] += report.cpu_seconds
    if costs:
        terminalreporter.section("processor time [s]")
        for line in summary(costs):
            terminalreporter.write_line(line)


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
