"""The README: its size, its links and its example."""

import re
import subprocess
import sys

import pytest

from jetbot_mjx.envs.task import LAYOUTS, layout_table


@pytest.fixture(scope="module")
def readme(root):
    return (root / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_the_observation_tables_are_the_layouts(name, root):
    assert layout_table(LAYOUTS[name]) in (root / "docs" / "task.md").read_text(encoding="utf-8")


def test_it_is_one_screen(readme):
    assert len(readme.split()) < 900


def test_every_file_that_is_named_exists(readme, root):
    named = set(
        re.findall(r"\b(?:configs|examples|benchmarks|docs|jetbot_mjx)/[\w/.-]+\.\w+", readme)
    )
    assert len(named) > 8
    missing = [name for name in named if not (root / name).is_file()]
    assert not missing


def test_every_configuration_is_listed(readme, root):
    for path in (root / "configs").glob("*.yaml"):
        assert f"`configs/{path.name}`" in readme


def test_the_smallest_example_runs(readme, root):
    example = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)[0]
    done = subprocess.run(
        [sys.executable, "-c", example], cwd=root, capture_output=True, text=True, check=True
    )
    shape, progress = done.stdout.rsplit(" ", 1)
    assert shape == "(4096, 16)"
    assert abs(float(progress)) < 0.02
