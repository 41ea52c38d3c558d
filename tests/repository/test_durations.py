"""The summary of what tests cost."""

import collections
import subprocess
import sys

from helpers import durations


def test_the_rooms_are_summed_and_the_dearest_tests_named():
    costs = {f"tests/envs/camera/test_a.py::test_{i}": 1.0 + i for i in range(durations.SHOWN + 5)}
    costs |= {"tests/runs/test_b.py::test_x[a/b::c]": 100.0, "tests/test_c.py::test_y": 0.25}
    rooms, _, tests = "\n".join(durations.summary(collections.Counter(costs))).partition("\n\n")
    assert rooms.split() == ["565.2", "all", "465.0", "envs", "100.0", "runs", "0.2", "test_c"]
    named = [line.split()[1] for line in tests.splitlines()]
    assert named[0] == "tests/runs/test_b.py::test_x[a/b::c]"
    assert len(named) == durations.SHOWN
    assert named[-1].endswith("::test_6")


def test_a_process_that_a_test_started_counts():
    before = durations.cpu_seconds()
    program = "import time\nwhile time.process_time() < 0.3: pass"
    subprocess.run([sys.executable, "-c", program], check=True)
    assert durations.cpu_seconds() - before > 0.3
