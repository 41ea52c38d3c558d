"""Reports and comparisons on small screens: tables scroll, and the page does not."""

import io
import json
import re
from html.parser import HTMLParser
from unittest import mock

import numpy as np
import pytest
from PIL import Image

from helpers import chromium
from helpers.reports import make_episodes, make_report, polar, return_report_of
from helpers.unpainted import unpainted
from jetbot_mjx.envs import OTHER_NUMERICS
from jetbot_mjx.evaluation import plots
from jetbot_mjx.evaluation.comparison import compare
from jetbot_mjx.evaluation.curves import CurvePoint, ReturnPoint
from jetbot_mjx.evaluation.html_report import write_comparison, write_report
from jetbot_mjx.evaluation.report import BestKnown, TimeGap
from jetbot_mjx.evaluation.return_report import compare_returns
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


def report_of(folder, won, name=LONG_RUN, settings=None):
    goals = polar(np.linspace(0.3, 1.2, len(won)), np.linspace(-170, 170, len(won)))
    report = make_report(make_episodes(goals, won), folder / name, settings=settings)
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


def test_a_comparison_has_the_best_known_times_as_the_terminal_has(tmp_path):
    report = report_of(tmp_path, np.ones(6))
    best = BestKnown(1.28, 1.72, TimeGap(-180.0, 180.0, 6, 1.3, 1.26, 0.03), ())
    found = {
        known: compare(
            tmp_path / str(known),
            {
                name: {"seed-0": report._replace(best_known=best if known else None)}
                for name in ("one", "other")
            },
        )
        for known in (True, False)
    }
    for known, comparison in found.items():
        with unpainted():
            page = write_comparison(comparison)
        for path in (page, page.with_suffix(".md")):
            rows = re.findall(r"best known[-| ]+([\d.]+) s[| ]*([\d.]+) s", text_of(path))
            assert rows == [("1.28", "1.72")] * known
            assert ("an open-loop search" in text_of(path)) is known
        seed = json.loads(page.with_suffix(".json").read_text())["runs"][1]["seeds"][0]
        assert (seed["best_known"] is not None) is known


@pytest.mark.parametrize("kind", ["goals", "starts"])
@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ((64, 64), "same {} at every checkpoint and in every run. Band"),
        (
            (1024, 64, 1024),
            "same {} at every checkpoint."
            " The runs have 64 or 1,024 {}, of which the first 64 are the same. Band",
        ),
    ],
)
def test_evaluations_of_which_runs_share_the_first_ones_only_are_not_called_equal(
    tmp_path, kind, counts, said
):
    settings = {f"run-{i}": {"evaluation": {"episodes": n}} for i, n in enumerate(counts)}
    if kind == "goals":
        runs = {
            name: {"seed-0": report_of(tmp_path, np.ones(2), name, own)}
            for name, own in settings.items()
        }
        comparison = compare(tmp_path, runs)
    else:
        curve = (ReturnPoint(2048, 1.0, 0.9, 1.1),)
        runs = {
            name: {"seed-0": return_report_of([1.0], curve=curve, **own)}
            for name, own in settings.items()
        }
        comparison = compare_returns(tmp_path, runs)._replace(versions=VERSIONS)
    with unpainted():
        page = write_comparison(comparison)
    assert said.format(kind, kind) in text_of(page)


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
    costly = costing(report, 0.02)
    assert "\neach step costs 0.02 m of the return\n" in summarize_report(costly)
    with unpainted():
        page = write_report(costly)
    assert "mean return, 0.02 m less for each step" in page.read_text("utf-8")
    assert "Each step costs 0.02 m of the return." in page.with_suffix(".md").read_text("utf-8")


def test_that_success_depends_on_the_simulator_is_told_where_intervals_do_not_overlap(tmp_path):
    report = report_of(tmp_path, np.ones(6))
    for low, high, told in ((0.2, 0.4, True), (0.2, report.policy.success_low, False)):
        there = report.policy._replace(success_low=low, success_high=high)
        both = report._replace(mujoco=MujocoResult(OTHER_NUMERICS, there, None))
        said = "success depends on the simulator's numerics"
        assert (said in summarize_report(both)) is told
    assert said not in summarize_report(report)


@pytest.mark.parametrize(
    ("rates", "said"),
    [
        ((0.5, 0.97, 1.0), ("stays at 95% or above", "1 to 2", "50.0% at 0.5")),
        ((0.5, 0.9, 0.4), ("is below 95% already at the preset", "  -  ", "40.0% at 2")),
    ],
)
def test_each_parameter_has_its_range_and_its_least_success(tmp_path, rates, said):
    report = report_of(tmp_path, np.ones(6))
    sweep = SWEEPS[0]._replace(values=(0.5, 1.0, 2.0))
    policy = tuple(report.policy._replace(success_rate=rate) for rate in rates)
    told = summarize_report(report._replace(robustness=(SweepResult(sweep, policy, policy),)))
    for text in said:
        assert text in told


def costing(report, cost):
    """A report whose task costs so much in each step [m]."""
    task = report.config.task.model_copy(update={"step_cost": cost})
    return report._replace(config=report.config.model_copy(update={"task": task}))


@pytest.mark.parametrize(
    ("costs", "said"),
    [
        ((0.0, 0.0), ""),
        ((0.02, 0.02), "each step costs 0.02 m of the return"),
        (
            (0.0, 0.02),
            "each step costs 0 m in a, 0.02 m in b, so the returns are not told beside each other",
        ),
    ],
)
def test_a_comparison_tells_what_a_step_costs(tmp_path, costs, said):
    runs = {
        name: {"seed-0": costing(report_of(tmp_path, np.ones(2), name), cost)}
        for name, cost in zip("ab", costs, strict=True)
    }
    comparison = compare(tmp_path / "comparison", runs)
    with unpainted():
        page = write_comparison(comparison)
    terminal, html, text = (
        summarize_comparison(comparison),
        page.read_text("utf-8"),
        page.with_suffix(".md").read_text("utf-8"),
    )
    if not said:
        assert not any("step costs" in one for one in (terminal, html, text))
        return
    assert f"\n{said}\n\n" in terminal
    assert f"Intervals here are over episodes. E{said[1:]}." in html
    assert f"\n\nE{said[1:]}.\n" in text


def test_returns_of_other_costs_are_not_told_beside_each_other(tmp_path):
    cheap = report_of(tmp_path, np.ones(2), "cheap")
    costly = costing(report_of(tmp_path, np.ones(2), "costly"), 0.02)
    told = f"{cheap.policy.episode_return:+.3f} m"
    for other, is_told in ((report_of(tmp_path, np.ones(2), "other"), True), (costly, False)):
        runs = {"a": {"seed-0": cheap}, "b": {"seed-0": other}}
        with unpainted():
            page = write_comparison(compare(tmp_path / "comparison", runs))
        rows = page.read_text("utf-8").partition("Every policy")[2].partition("</table>")[0]
        assert (told in rows) == is_told
        text = page.with_suffix(".md").read_text("utf-8")
        assert (f"{told} |" in text.partition("Every policy")[2]) == is_told


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


SHOWN = """(() => {
  const shown = e => e.getBoundingClientRect().height > 0;
  const images = [...document.querySelectorAll('figure img')].filter(shown);
  return JSON.stringify(images.map(e => e.naturalWidth));
})()"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_are_dark_on_a_dark_screen_and_light_on_paper(tmp_path, scheme):
    if chromium.find() is None:
        pytest.skip("no Chromium to look at the page with")
    widths = {"light": 11, "dark": 13}

    def painted(figure):
        """Return a picture whose width tells the theme that it was drawn in."""
        width = widths["light" if figure.get_facecolor()[0] > 0.5 else "dark"]
        png = io.BytesIO()
        Image.new("RGB", (width, 7), "white").save(png, "png")
        return png.getvalue()

    with mock.patch.object(plots, "to_png", painted):
        page = write_report(report_of(tmp_path, np.ones(6)))
    with chromium.browse(tmp_path / "chromium", dark=scheme == "dark") as browser:
        browser.open_and_wait(page.as_uri())
        assert json.loads(browser.evaluate(SHOWN)) == [widths[scheme]] * 4
        printed = re.findall(rb"/Subtype /Image\s+/Width (\d+)", browser.print())
    assert {int(width) for width in printed} == {widths["light"]}
