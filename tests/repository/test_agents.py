"""What coding assistants read: every name in it is one of the code, and every page is there."""

import importlib
import json
import re
import statistics
from pathlib import Path

import pytest

from benchmarks import RESULTS
from helpers.doc_pages import ALL_PAGES, DOCS, PAGES, REFERENCE, ROOT
from jetbot_mjx import __main__ as overview
from jetbot_mjx.config import shipped_folder
from jetbot_mjx.evaluation import Report
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.training.result import Result
from jetbot_mjx.tuning import TuningResult
from jetbot_mjx.viewers.gallery import Rendered

INDEX = (DOCS / "llms.txt").read_text("utf-8")
PAGE = PAGES["agents.md"]
RETURNED = {"train": Result, "evaluate": Report, "render": Rendered, "tune": TuningResult}


def table(heading):
    """Rows of the first table below a heading, without its head."""
    text = PAGE.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in row] for row in rows[1:]]


# llms.txt


def test_the_index_has_the_conventional_form():
    title, quote, *rest = re.sub(r"(?<!\n)\n(> |  )", " ", INDEX).split("\n\n")
    assert title == "# jetbot_mjx"
    assert quote.startswith("> ")
    sections = "\n\n".join(rest).split("\n## ")[1:]
    assert len(sections) > 4
    for section in sections:
        _, _, links = section.partition("\n\n")
        assert all(
            re.fullmatch(r"- \[.+?\]\(\S+\): .+", line) for line in links.splitlines() if line
        )


def test_the_index_lists_every_page_once():
    listed = re.findall(r"\]\((\S+)\)", INDEX)
    assert sorted(listed) == sorted(ALL_PAGES.keys() - REFERENCE.keys())


def test_the_index_names_pages_by_their_titles():
    for name, page in re.findall(r"\[(.+?)\]\((\S+)\)", INDEX):
        if page != "index.md":
            assert f"[{name}]({page})" in PAGES["index.md"]


def test_the_pages_are_shipped():
    assert shipped_folder("docs") == DOCS
    rules = (ROOT / "pyproject.toml").read_text("utf-8")
    assert 'docs = "jetbot_mjx/docs"' in rules
    endings = set(re.findall(r'"/docs/\*(\.\w+)"', rules))
    assert {path.suffix for path in DOCS.rglob("*.*")} - endings - {".pyc"} == {".md", ".txt"}


def test_the_overview_names_the_index(capsys):
    assert overview.main([]) == 0
    name, _, path = capsys.readouterr().out.splitlines()[-1].partition(": ")
    assert name == "for coding assistants"
    assert Path(path).read_text("utf-8") == INDEX


# agents.md


def test_the_page_names_every_command_and_no_other():
    # Those in tables and text; those in blocks are tested with the commands of all pages.
    named = set(re.findall(r"\bjetbot-mjx\s+([a-z][\w-]+)", PAGE))
    assert named == set(overview.COMMANDS)


@pytest.mark.parametrize("name", re.findall(r"`((?:jetbot_mjx|onekernel)\.[\w.]+)`", PAGE))
def test_a_name_of_the_page_resolves(name):
    module, _, last = name.rpartition(".")
    assert hasattr(importlib.import_module(module), last)


def test_the_page_lists_every_public_name():
    stub = (ROOT / "jetbot_mjx/__init__.pyi").read_text("utf-8")
    public = re.findall(r"^from \S+ import (\w+) as \1$", stub, re.M)
    assert set(public) <= set(re.findall(r"`jetbot_mjx\.(\w+)`", PAGE))


def test_results_have_what_the_page_says():
    returned = {row[0].strip("`").partition(".")[2]: row[2] for row in table("In Python")}
    for name, kind in RETURNED.items():
        names = re.findall(r"`(\w+)`", returned[name])
        assert names
        assert [x for x in names if not hasattr(kind, x) and x not in Summary._fields] == []


def test_a_report_has_what_the_page_says():
    names = re.findall(r"`policy\.(\w+)`", PAGE)
    assert len(names) == 3
    assert set(names) <= set(Summary._fields)


def test_a_run_holds_what_the_page_says(smoke_run):
    paths = [row[0].strip("`") for row in table("What a run holds")]
    missing = {path for path in paths if not (smoke_run / path).exists()}
    assert missing == {"evaluations/"}  # nothing has evaluated it
    last = json.loads((smoke_run / "metrics.jsonl").read_text().splitlines()[-1])
    assert {"env_steps", "eval/success_rate"} <= last.keys()


@pytest.mark.parametrize(
    ("config", "file"),
    [("jetbot_egocentric", "cpu-egocentric.json"), ("jetbot", "cpu-world.json")],
)
def test_the_times_are_those_that_were_measured(config, file):
    runs = json.loads((RESULTS / file).read_text("utf-8"))["runs"]
    cold, warm = (
        statistics.median(run["process_seconds"] for run in runs if run["start"] == start)
        for start in ("cold", "warm")
    )
    told = {row[0]: row[1:] for row in table("How long it takes")}
    assert told[f"`jetbot-mjx train {config}`"] == [
        f"{cold:.0f} s",
        f"{warm:.0f} s when its programs are cached",
    ]


def test_the_exit_codes_are_those_of_the_whole_list():
    codes = {row[0].partition(",")[0] for row in table("Errors and exit codes")}
    whole = PAGES["stop-and-resume.md"].partition("## Exit codes")[2].partition("\n## ")[0]
    assert codes <= set(re.findall(r"^\| (\d+) \|", whole, re.M))
