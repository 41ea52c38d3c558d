"""Plot episodes and evaluation results; each function returns a figure and writes no file.

The colours come from the theme in which a figure is drawn: `with theme("dark"): ...`.
"""

import contextlib
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib import rc_params_from_file
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import FuncFormatter, PercentFormatter
from matplotlib.typing import ColorType

from jetbot_mjx.evaluation.evaluator import final_distances, path_efficiencies
from jetbot_mjx.evaluation.report import SECTORS, GoalBin, Report
from jetbot_mjx.evaluation.robustness import ROBUST_SUCCESS_RATE, SweepResult
from jetbot_mjx.evaluation.rollout import Episodes

Theme = Literal["light", "dark"]
THEMES: tuple[Theme, ...] = ("light", "dark")

_ASSETS = Path(__file__).parents[1] / "assets"

_REACHED, _MISSED = "C0", "C1"

_OUTCOMES = ((True, _REACHED, "reached"), (False, _MISSED, "not reached"))

_DPI = 160


@contextlib.contextmanager
def theme(name: Theme) -> Iterator[None]:
    """Set the colours of figures that are drawn inside the context to a light or dark theme."""
    with matplotlib.rc_context():
        for style in ("plots", name):
            path = _ASSETS / f"{style}.mplstyle"
            matplotlib.rcParams.update(rc_params_from_file(path, use_default_template=False))
        yield


def to_png(figure: Figure) -> bytes:
    """Return a figure as PNG, with the same bytes for the same figure every time."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def plot_trajectories(
    episodes: Episodes,
    title: str = "",
    others_w: Sequence[Float[np.ndarray, "n 3"]] = (),
    which: Sequence[int] | None = None,
) -> Figure:
    """Plot the trajectories and goals of recorded episodes as seen from above.

    Args:
      episodes: recorded episodes.
      title: title of the figure.
      others_w: positions of other objects in each episode [m], world frame, drawn as grey dots.
      which: indices of the episodes to draw, the last on top; None: all.

    Returns:
      The figure.
    """
    if episodes.qpos is None:
        raise ValueError("these episodes were not recorded: rollout_fn(..., record=True)")
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    axes = figure.add_subplot()
    # Draw each trajectory with its goal as a square and its end as a dot.
    drawn = range(episodes.success.size) if which is None else which
    for index in drawn:
        colour = _REACHED if episodes.success[index] > 0 else _MISSED
        way = np.asarray(episodes.qpos[index, : int(episodes.steps[index]) + 1, :2])
        goal_w = np.asarray(episodes.goal_w[index])
        axes.plot(way[:, 0], way[:, 1], color=colour, linewidth=1.0, alpha=0.7)
        axes.add_patch(
            Rectangle((goal_w[0] - 0.05, goal_w[1] - 0.05), 0.1, 0.1, color=colour, alpha=0.3, lw=0)
        )
        axes.plot(*way[-1], marker="o", color=colour, markersize=3)
    for places in others_w:
        axes.scatter(places[:, 0], places[:, 1], color="grey", alpha=0.5, zorder=0)
    # Add the start, the legend and the limits.
    ink = matplotlib.rcParams["text.color"]
    axes.plot(0, 0, marker=(3, 0, -90), color=ink, ls="", ms=11, label="start, heading +x")
    reached = {bool(episodes.success[index] > 0) for index in drawn}
    for outcome, colour, label in _OUTCOMES:
        if outcome in reached:
            axes.plot([], [], color=colour, label=label)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    reach = 1.1 * max(1.25, float(np.abs(np.asarray(episodes.goal_w)[:, :2]).max()))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.grid()
    axes.set_axisbelow(True)
    axes.legend(loc="upper left", fontsize="small")
    return figure


def plot_by_goal(goal_bins: Sequence[GoalBin]) -> Figure:
    """Plot success and time over the goal's distance and bearing, as seen from above the start.

    Args:
      goal_bins: the bins of a report.

    Returns:
      The figure, in which bins without a goal or without a time are hatched.
    """
    figure = Figure(figsize=(10.4, 5.4), layout="constrained")
    success, seconds = figure.subplots(1, 2, subplot_kw={"projection": "polar"})
    middle = matplotlib.rcParams["grid.color"]
    cycle = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"]
    ramp = LinearSegmentedColormap.from_list
    medians = [goal_bin.time_to_goal_median for goal_bin in goal_bins]
    times = [median for median in medians if median is not None]
    slowest, fastest = max(times, default=1.0), min(times, default=0.0)
    _polar(
        success,
        goal_bins,
        [goal_bin.success_rate for goal_bin in goal_bins],
        [f"{goal_bin.successes}\nof {goal_bin.episodes}" for goal_bin in goal_bins],
        ramp("", [cycle[1], middle, cycle[0]]),
        Normalize(0, 1),
    )
    _polar(
        seconds,
        goal_bins,
        medians,
        [f"{median or 0:.2f}" for median in medians],
        ramp("", [middle, cycle[3]]),
        Normalize(fastest - 0.15 * (slowest - fastest) - 1e-6, slowest),
    )
    success.set_title("Goals reached", pad=22)
    seconds.set_title("Median time to goal [s]", pad=22)
    return figure


def _polar(
    axes: PolarAxes,
    goal_bins: Sequence[GoalBin],
    values: Sequence[float | None],
    labels: Sequence[str],
    colours: Colormap,
    scale: Normalize,
) -> None:
    """Draw bins as rings and sectors, with straight ahead at the top and left on the left."""
    # Fill each bin with its value and label it.
    ink, paper = (matplotlib.rcParams[key] for key in ("text.color", "figure.facecolor"))
    for goal_bin, value, label in zip(goal_bins, values, labels, strict=True):
        middle = np.radians(goal_bin.bearing_low + goal_bin.bearing_high) / 2
        height = goal_bin.distance_high - goal_bin.distance_low
        place = {"width": np.radians(360 / SECTORS), "bottom": goal_bin.distance_low}
        if value is None:
            axes.bar(middle, height, **place, facecolor="none", hatch="////", lw=0)
            continue
        fill = colours(scale(value))
        axes.bar(middle, height, **place, color=fill, edgecolor=paper, linewidth=1.5)
        # Choose the text colour that has more contrast with the fill.
        text = max((ink, paper), key=lambda colour, fill=fill: _contrast(colour, fill))
        radius = goal_bin.distance_low + 0.5 * height
        axes.text(middle, radius, label, ha="center", va="center", color=text, fontsize=7)
    # Label the rings with distances and the sectors with bearings.
    edges = sorted(
        {goal_bin.distance_low for goal_bin in goal_bins}
        | {goal_bin.distance_high for goal_bin in goal_bins}
    )
    axes.set_theta_zero_location("N")
    axes.set_ylim(0, edges[-1])
    axes.set_yticks(edges, [f"{edge:g} m" for edge in edges], fontsize=7)
    for label in axes.get_yticklabels():
        label.set_bbox({"boxstyle": "round,pad=0.15", "fc": paper, "ec": "none"})
    axes.set_rlabel_position(180 / SECTORS)
    bearings = np.arange(SECTORS) * 360 // SECTORS
    names = [f"{b if b <= 180 else b - 360:+d}°" if b % 180 else f"{b}°" for b in bearings]
    names[0] = "ahead 0°"
    axes.set_xticks(np.radians(bearings), names, fontsize=8)
    axes.grid(visible=False)
    axes.spines["polar"].set_visible(False)
    axes.plot(0, 0, marker="^", color=ink, markersize=9)


def _contrast(one: ColorType, other: ColorType) -> float:
    """Return the difference in perceived brightness between two colours."""
    low, high = sorted(float(np.dot(to_rgb(c), (0.299, 0.587, 0.114))) for c in (one, other))
    return high - low


def plot_distributions(report: Report) -> Figure:
    """Plot histograms of the final distances to the goal and of the successes' path efficiency.

    Args:
      report: the report of one policy.

    Returns:
      The figure.
    """
    episodes = report.episodes
    won = np.asarray(episodes.success) > 0
    remaining = final_distances(episodes)
    # Left: final distance of all episodes.
    figure = Figure(figsize=(10.4, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    radius = report.config.task.success_radius
    bins = np.linspace(0, max(float(remaining.max()), 2 * radius), 61)
    some = [one for one in _OUTCOMES if one[0] in won]
    left.hist(
        [remaining[won == outcome] for outcome, _, _ in some],
        bins=bins.tolist(),
        stacked=True,
        color=[colour for _, colour, _ in some],
        label=[label for _, _, label in some],
        log=True,
    )
    ink = matplotlib.rcParams["text.color"]
    left.axvline(radius, color=ink, lw=1, ls="--", label=f"success radius {radius:g} m")
    left.set(xlabel="distance to the goal at the end [m]", ylabel="goals (logarithmic)")
    left.set_ylim(bottom=0.7)
    left.yaxis.set_major_formatter(FuncFormatter(lambda count, _: f"{count:g}"))
    left.set_title("Final distance")
    left.legend(fontsize="small")
    # Right: path efficiency of the successes.
    right.set_title("Path efficiency of the successes")
    if won.any():
        right.hist(path_efficiencies(episodes)[won], bins=40, color=_REACHED)
        right.set(xlabel="straight line over way travelled", ylabel="goals")
        right.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    else:
        right.set_axis_off()
        right.text(0.5, 0.5, "no goal was reached", ha="center", transform=right.transAxes)
    return figure


def plot_robustness(results: Sequence[SweepResult]) -> Figure:
    """Plot the robustness of a policy: success rate and time to goal over each parameter.

    Args:
      results: the results of one policy, one for each parameter.

    Returns:
      The figure. Bands are 95 % Wilson intervals; a dashed line marks the preset's value.
    """
    medians = [
        summary.time_to_goal_median or 0.0
        for result in results
        for summary in (*result.policy, *result.scripted)
    ]
    # Lay out a grid with two axes for each parameter: success above, time below.
    ink = matplotlib.rcParams["text.color"]
    columns = min(3 if len(results) <= 9 else 4, len(results))
    lines = -(-len(results) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.6 * lines), layout="constrained")
    grid = figure.add_gridspec(2 * lines, columns, height_ratios=[3, 2] * lines)
    # Plot each parameter for the policy and for the scripted controller.
    for index, result in enumerate(results):
        line, column = divmod(index, columns)
        success = figure.add_subplot(grid[2 * line, column])
        time = figure.add_subplot(grid[2 * line + 1, column], sharex=success)
        for name, summaries, colour in (
            ("scripted", result.scripted, "tab:gray"),
            ("policy", result.policy, "C0"),
        ):
            values = result.sweep.values
            rates = [(one.success_rate, one.success_low, one.success_high) for one in summaries]
            plot_band(success, values, rates, color=colour, label=name)
            seconds = [summary.time_to_goal_median for summary in summaries]
            time.plot(values, np.array(seconds, float), marker="o", markersize=4, color=colour)
        for axes in (success, time):
            axes.axvline(result.sweep.nominal, color=ink, linestyle="--", linewidth=0.8)
            axes.grid(alpha=0.3)
        success.axhline(ROBUST_SUCCESS_RATE, color=ink, linestyle=":", linewidth=0.8)
        success.set(ylim=(-0.03, 1.03), title=result.sweep.label)
        success.yaxis.set_major_formatter(PercentFormatter(1.0))
        success.tick_params(labelbottom=False)
        time.set(xlabel=f"[{result.sweep.unit}]", ylim=(0.0, 1.1 * max(medians) or 1.0))
        if column == 0:
            success.set(ylabel="success")
            time.set(ylabel="median time\nto goal [s]")
        if index == 0:
            success.legend(loc="lower right", fontsize="small")
    return figure


def plot_band(
    axes: Axes,
    x: Sequence[float],
    values: Sequence[tuple[float, float, float]],
    *,
    color: str,
    label: str,
) -> None:
    """Draw a quantity over something, with its intervals as a band.

    Args:
      axes: the axes to draw on.
      x: the horizontal position of each value.
      values: the quantity, and the lower and the upper end of its interval.
      color: the colour of line and band.
      label: what the legend says.
    """
    middle, low, high = zip(*values, strict=True)
    axes.fill_between(x, low, high, color=color, alpha=0.25, lw=0)
    axes.plot(x, middle, color=color, marker="o", markersize=4, label=label)
