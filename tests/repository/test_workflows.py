"""The workflows of GitHub: `make check` audits them, and they call what there is."""

import re
import tomllib

import pytest
from ruamel.yaml import YAML


@pytest.fixture(scope="module")
def workflows(root):
    paths = sorted((root / ".github" / "workflows").glob("*.yml"))
    return {path.name: YAML(typ="safe", pure=True).load(path) for path in paths}


def jobs(workflows):
    return [job for workflow in workflows.values() for job in workflow["jobs"].values()]


def test_every_workflow_is_told_to_contributors(workflows, root):
    text = (root / "CONTRIBUTING.md").read_text("utf-8")
    assert len(workflows) == 5
    assert all(f"| `{name}` |" in text for name in workflows)


def test_they_make_targets_that_there_are(workflows, root):
    known = re.findall(r"^([\w-]+):", (root / "Makefile").read_text(), re.MULTILINE)
    lines = [step.get("run", "") for job in jobs(workflows) for step in job["steps"]]
    made = [line.split()[1] for line in lines if line.startswith("make ")]
    assert set(made) <= set(known)
    assert {"test", "check", "docs", "wheel", "release-check"} <= set(made)


def test_no_job_may_do_more_than_it_needs(workflows):
    assert all(workflow["permissions"] == {} for workflow in workflows.values())
    assert all("concurrency" in workflow for workflow in workflows.values())
    assert all("timeout-minutes" in job for job in jobs(workflows))
    writers = [job for job in jobs(workflows) if "write" in job["permissions"].values()]
    assert [job["environment"] for job in writers if "pages" not in job["permissions"]] == ["pypi"]


def test_the_slow_tests_of_every_room_run_once_a_week(workflows, root):
    job = workflows["weekly.yml"]["jobs"]["slow"]
    rooms = {
        path.relative_to(root / "tests").parts[0]
        for path in (root / "tests").rglob("test_*.py")
        if re.search(r"mark\.slow|slow_unless", path.read_text("utf-8"))
    }
    assert {*job["strategy"]["matrix"]["room"]} == rooms
    assert job["steps"][-1] == {
        "run": "make test-slow",
        "env": {"TESTS": "tests/${{ matrix.room }}"},
    }


def test_an_action_has_one_version(workflows):
    used = [step["uses"] for job in jobs(workflows) for step in job["steps"] if "uses" in step]
    names = {use: use.partition("@")[0] for use in used}
    assert len(names) == len(set(names.values()))


def test_the_tests_run_with_every_supported_python(workflows, root):
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    named = [line.rpartition(" :: ")[2] for line in project["classifiers"] if ":: 3." in line]
    matrix = workflows["tests.yml"]["jobs"]["test"]["strategy"]["matrix"]
    assert matrix["python"] == named
