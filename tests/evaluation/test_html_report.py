"""Reports and comparisons on small screens: tables scroll, and the page does not."""

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from helpers import chromium
from helpers.reports import make_episodes, make_report, polar
from helpers.unpainted import unpainted
from jetbot_mjx.envs import OTHER_NUMERICS
from jetbot_mjx.evaluation.comparison import compare
from jetbot_mjx.evaluation.curves import CurvePoint
from jetbot_mjx.evaluation.html_report import write_comparison, write_report
from jetbot_mjx.evaluation.robustness import SWEEPS, MujocoResult, SweepResult
from jetbot_mjx.evaluation.tables import summarize_comparison, summarize_report

LONG_RUN = "runs/a-run-with-a-name-that-is-as-long-as-people-make-them-20261123-101500"
VERSIONS = {
    "python": "3.11.7",
    "platform": "Linux-6.1.0-26-amd64-x86_64-with-glibc2.36",
    "device": "NVIDIA H200",
    "device_count": 1,
    "packages": {"jax": "0.10.2", "mujoco": "3.17.0"},
    "git": {"commit": "0123456789abcdef", "changed": True},
}


def report_of(folder, won, name=LONG_RUN):
    goals = polar(np.linspace(0.3, 1.2, len(won)), np.linspace(-170, 170, len(won)))
    report = make_report(make_episodes(goals, won), folder / name)
    return report._replace(
        folder=folder / name / "report",
        versions=VERSIONS,
        baselines={"scripted": report.policy, "random": report.policy},
        learning_curve=(CurvePoint(2048, 0.5, 0.4, 0.6, 1.0),),
        episodes=report.episodes._replace(qpos=np.zeros((len(won), 61, 9))),
    )


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The pages of reports by the number of failures, and that of a comparison."""
    folder = tmp_path_factory.mktemp("pages")
    written = {}
    with unpainted():
        for failures in (0, 1, 12):
            won = np.ones(24)
            won[:failures] = 0
            report = report_of(folder / str(failures), won)
            swept = tuple(
                SweepResult(sweep, *[(report.policy,) * len(sweep.values)] * 2)
                for sweep in SWEEPS[:3]
            )
            written[failures] = write_report(report._replace(robustness=swept))
        runs = {
            f"a-run-with-a-rather-long-name-{seed}": {
                "seed-0": report_of(folder / "runs", won, f"run-{seed}")
            }
            for seed in range(3)
        }
        written["comparison"] = write_comparison(compare(folder / "comparison", runs))
    return written


def text_of(page):
    """What a reader sees of a page, without line breaks."""
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", page.read_text("utf-8")))


def test_a_comparison_has_both_simulators_pictures_of_policies_that_see(tmp_path):
    report = report_of(tmp_path, np.ones(6))
    few = report.policy._replace(episodes=3, successes=2, success_rate=2 / 3)
    seen = MujocoResult(
        OTHER_NUMERICS, report.policy, None, {"plain": report.policy, "varied": few}
    )
    runs = {
        "camera": {"seed-0": report._replace(mujoco=seen)},
        "blind": {"seed-0": report_of(tmp_path, np.ones(6), "blind")},
    }
    with unpainted():
        page = write_comparison(compare(tmp_path / "comparison", runs))
    for text in (text_of(page), text_of(page.with_suffix(".md"))):
        rows = re.findall(r"camera in C MuJoCo, (plain|varied) pictures\W+([\d.]+)", text)
        assert rows == [("plain", "100.00"), ("varied", "66.67")]
        assert "blind in C MuJoCo" not in text
        assert "on the first 3 goals" in text


class Tables(HTMLParser):
    """The classes of the element around each table."""

    def __init__(self, text):
        super().__init__()
        self.around, self._open = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.around.append(self._open[-1])
        if tag in ("div", "section", "details"):
            self._open.append(dict(attrs).get("class", ""))

    def handle_endtag(self, tag):
        if tag in ("div", "section", "details"):
            self._open.pop()


@pytest.mark.parametrize("which", [1, "comparison"])
def test_every_table_scrolls_by_itself(pages, which):
    page = pages[which].read_text("utf-8")
    around = Tables(page).around
    assert len(around) >= 4
    assert set(around) == {"scroll"}
    # A column whose words may break anywhere gets one letter wide, unless it has a smallest width.
    for rule in re.findall(
        r"[^{}]+\{[^{}]*overflow-wrap: anywhere[^{}]*\}", page.split("@media print")[0]
    ):
        assert rule.strip().startswith("h1") or "min-width" in rule, rule


@pytest.mark.parametrize(
    ("failures", "said"),
    [
        (0, "All 24 goals reached. Squares are goals"),
        (1, "The one goal not reached, and all 23 goals reached. Squares"),
        (12, "All 12 goals not reached, and all 12 goals reached. Squares"),
        (1, "How the episode ended: time limit. This command renders it: jetbot-mjx render"),
        (12, "How the episodes ended: time limit (12). This command renders the first 8 of them: "),
    ],
)
def test_one_goal_is_not_spoken_of_as_many(pages, failures, said):
    assert said in text_of(pages[failures])


def test_one_goal_in_the_terminal(tmp_path):
    said = summarize_report(report_of(tmp_path, np.ones(1)))
    assert said.startswith("1 fixed goal (set 1), policy after")
    runs = {name: {"seed-0": report_of(tmp_path, np.ones(2), name)} for name in "ab"}
    assert summarize_comparison(compare(tmp_path, runs)).startswith("2 fixed goals (set 1), 2 pol")


def test_a_cost_of_steps_is_told_beside_the_return(tmp_path):
    report = report_of(tmp_path, np.ones(2))
    assert "costs" not in summarize_report(report)
    task = report.config.task.model_copy(update={"step_cost": 0.02})
    costly = report._replace(config=report.config.model_copy(update={"task": task}))
    assert "\neach step costs 0.02 m of the return\n" in summarize_report(costly)
    with unpainted():
        page = write_report(costly)
    assert "mean return, 0.02 m less for each step" in page.read_text("utf-8")
    assert "Each step costs 0.02 m of the return." in page.with_suffix(".md").read_text("utf-8")


LOOK = """(() => {
  const width = document.documentElement.clientWidth;
  const scrolls = e =>
    e && (getComputedStyle(e).overflowX != 'visible' || scrolls(e.parentElement));
  const all = selector => [...document.querySelectorAll(selector)];
  const box = e => e.getBoundingClientRect();
  return JSON.stringify({
    page: document.documentElement.scrollWidth - width,
    outside: all('main *').filter(e => box(e).right > width && !scrolls(e.parentElement))
      .map(e => e.outerHTML.slice(0, 80)),
    tall: all('td, th').filter(e => box(e).height > 0.5 * width && box(e).height > 200)
      .map(e => e.innerText),
    broken: all('td').filter(e => /^\\\\S{4,16}$/.test(e.innerText) && box(e).height > 50)
      .map(e => e.innerText),
  });
})()"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if chromium.find() is None:
        pytest.skip("no Chromium to look at the page with")
    with chromium.browse(tmp_path_factory.mktemp("chromium")) as page:
        yield page


@pytest.mark.parametrize("width", [400, 700, 1000])
@pytest.mark.parametrize("which", [0, 1, 12, "comparison"])
def test_no_page_scrolls_sideways(browser, pages, which, width):
    browser.resize(width, 800)
    browser.open_and_wait(pages[which].as_uri())
    browser.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    found = json.loads(browser.evaluate(LOOK))
    assert found == {"page": 0, "outside": [], "tall": [], "broken": []}
