"""Write reports as files: JSON with all values, figures, one HTML page and one Markdown page.

A page takes each number from the values of its JSON file by key, so the page and the file cannot
differ. The HTML page embeds its figures and needs no network access.
"""

import base64
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import jinja2
from jaxtyping import PyTree
from markupsafe import Markup
from matplotlib.figure import Figure

from jetbot_mjx.evaluation import learning_curves, plots, return_plots
from jetbot_mjx.evaluation.comparison import Comparison, told_step_cost
from jetbot_mjx.evaluation.moments import plot_moments, shown_goals
from jetbot_mjx.evaluation.report import Report, replay_command
from jetbot_mjx.evaluation.return_report import ReturnComparison, ReturnReport
from jetbot_mjx.runs import JsonObject, make_folder, write_bytes, write_json, write_text, writing_to

LISTED_FAILURES = 50
"""Largest number of failures on a page; the JSON file lists all of them."""

_MAX_REPLAYED = 8

_OPTIONAL_FIGURES = {
    "report": {"learning_curve", "losses", "robustness", "seen"},
    "comparison": {"learning_curves"},
    "return_report": {"learning_curve"},
    "return_comparison": {"learning_curves"},
}
"""Names of the figures that the page of a template may lack."""

_PAGES = jinja2.Environment(
    loader=jinja2.PackageLoader("jetbot_mjx", "assets"),
    autoescape=jinja2.select_autoescape(["html"]),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    # Show floating-point settings with six significant digits, which are enough for a reader.
    finalize=lambda value: f"{value:.6g}" if isinstance(value, float) else value,
)

# Escape vertical bars, which would start the next cell of a Markdown table.
_PAGES.filters["cell"] = lambda text: text.replace("|", "\\|")


def write_report(report: Report) -> Path:
    """Write a report into its folder.

    Args:
      report: the report of one policy.

    Returns:
      The path of `report.html`; `report.md`, `report.json` and the figures are in the same folder.

    Raises:
      UserError: the folder cannot be written.
    """
    # Choose the figures.
    episodes = report.episodes
    # A plan view stays readable with so many; the failures are drawn on top.
    shown = shown_goals(episodes, successes=100, failures=200)
    successes = sum(bool(episodes.success[index] > 0) for index in shown)
    figures = {
        "by_goal": lambda: plots.plot_by_goal(report.goal_bins),
        "trajectories": lambda: plots.plot_trajectories(episodes, which=shown),
        "distributions": lambda: plots.plot_distributions(report),
    }
    if report.learning_curve:
        figures["learning_curve"] = lambda: learning_curves.plot_learning_curve(report)
    if report.losses:
        figures["losses"] = lambda: learning_curves.plot_losses(report)
    if report.robustness:
        figures["robustness"] = lambda: plots.plot_robustness(report.robustness)
    if report.seen:
        figures["seen"] = lambda: plot_moments(report.seen)
    # Write them with the commands that reproduce the report and show its failures.
    goals = [failure.goal for failure in report.failures if failure.replay][:_MAX_REPLAYED]
    return _write(
        report.folder,
        "report",
        report.to_json(),
        figures,
        {
            "shown": {"successes": successes, "failures": len(shown) - successes},
            "listed": LISTED_FAILURES,
            "replay": replay_command(report.run, report.env_steps, goals),
            "replayed": len(goals),
            "evaluate_command": report.evaluate_command(),
            "step_cost": report.config.task.step_cost,
            "clips": [(clip, _data_uri(clip.mp4, "video/mp4")) for clip in report.clips],
        },
    )


def write_comparison(comparison: Comparison | ReturnComparison) -> Path:
    """Write a comparison into its folder.

    Args:
      comparison: a comparison of runs whose own reports are already written.

    Returns:
      The path of `comparison.html`; `comparison.md`, `comparison.json` and the figures are in the
      same folder.

    Raises:
      UserError: the folder cannot be written.
    """
    figures = {"runs": lambda: learning_curves.plot_runs(comparison)}
    if any(run.learning_curve for run in comparison.runs):
        figures["learning_curves"] = lambda: learning_curves.plot_learning_curves(comparison)
    links = [
        [os.path.relpath(one.folder / "report", comparison.folder) for one in run.seeds.values()]
        for run in comparison.runs
    ]
    template, more = "return_comparison", JsonObject(links=links)
    if isinstance(comparison, Comparison):
        template = "comparison"
        cost = told_step_cost(comparison)
        more["step_cost"] = f"{cost[0].upper()}{cost[1:]}." if cost else ""
    return _write(comparison.folder, "comparison", comparison.to_json(), figures, more, template)


def write_return_report(report: ReturnReport) -> Path:
    """Write a report on a policy of an environment of one's own, as `write_report` does.

    Args:
      report: the report of one policy.

    Returns:
      The path of `report.html`.

    Raises:
      UserError: the folder cannot be written.
    """
    figures = {"returns": lambda: return_plots.plot_returns(report)}
    if report.learning_curve:
        figures["learning_curve"] = lambda: return_plots.plot_return_curve(report)
    more = {"evaluate_command": report.evaluate_command()}
    return _write(report.folder, "report", report.to_json(), figures, more, "return_report")


def _write(
    folder: Path,
    name: str,
    values: JsonObject,
    figures: Mapping[str, Callable[[], Figure]],
    more: JsonObject,
    template: str | None = None,
) -> Path:
    """Draw all figures and render all pages, then write the files, the HTML page last."""
    template = template or name
    drawn = {figure: _draw(draw) for figure, draw in figures.items()}
    images = {
        figure: {"file": f"{figure}.png", **{name: _data_uri(png) for name, png in pngs.items()}}
        for figure, pngs in drawn.items()
    }
    pages = {
        suffix: _PAGES.get_template(f"{template}{suffix}").render(
            values=values, figures=images, number=_numbers(values, suffix), **more
        )
        for suffix in (".md", ".html")
    }
    make_folder(folder)
    with writing_to(folder):
        # Remove figures of an earlier report that this one does not have.
        for figure in sorted(_OPTIONAL_FIGURES[template] - drawn.keys()):
            (folder / f"{figure}.png").unlink(missing_ok=True)
        for figure, pngs in drawn.items():
            write_bytes(folder / f"{figure}.png", pngs["light"])
        write_json(folder / f"{name}.json", values)
        for suffix, text in pages.items():
            write_text(folder / f"{name}{suffix}", text)
    return folder / f"{name}.html"


def _draw(draw: Callable[[], Figure]) -> dict[str, bytes]:
    """Draw a figure in every theme and return the PNG files, by the name of the theme."""
    pngs = {}
    for name in plots.THEMES:
        with plots.theme(name):
            pngs[name] = plots.to_png(draw())
    return pngs


def _data_uri(content: bytes, kind: str = "image/png") -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _numbers(values: JsonObject, suffix: str) -> Callable[[str, str], str]:
    """Return a function of a JSON value's path, such as `policy.success_rate`, and its format."""

    def number(place: str, form: str) -> str:
        value: PyTree = values
        for key in place.split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
        text = "-" if value is None else form.format(value)
        if suffix != ".html":
            return text
        exact = json.dumps(value)
        return Markup('<data value="{}" data-json="{}">{}</data>').format(exact, place, text)

    return number
