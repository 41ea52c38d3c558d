"""Plot rates from files of results: `python benchmarks/throughput/rate_plots.py FILE...`."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.formatting import format_count
from jetbot_mjx import cli
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.plots import theme, to_png
from jetbot_mjx.runs.run_dir import write_bytes


def plot_rates(values: Mapping[str, Any]) -> Figure:
    """Plot steps per second, the time of one step and memory over the number of environments.

    Memory is plotted if the device reports it. Its peak is that of the whole process so far, so
    that sizes should be measured in ascending order.

    Args:
      values: The content of a file that `steps_per_second.py` wrote.

    Returns:
      The figure, in the colours of the active theme.
    """
    # Create two axes, or three if memory was measured.
    rows = values["results"]
    has_memory = any(row.get("peak_device_bytes") for row in rows)
    figure = Figure(figsize=(15.0 if has_memory else 10.4, 4.4), layout="constrained")
    rates, times, *others = figure.subplots(1, 3 if has_memory else 2)
    # Plot one line for each rate, with a band from its slowest to its fastest repeat.
    for index, rate in enumerate(dict.fromkeys(row["rate"] for row in rows)):
        points = sorted((row for row in rows if row["rate"] == rate), key=lambda x: x["num_envs"])
        num_envs = [row["num_envs"] for row in points]
        style: Any = {"color": f"C{index}", "marker": "o", "markersize": 4, "lw": 1.5}
        medians = [row["env_steps_per_second"] for row in points]
        rates.fill_between(
            num_envs,
            [min(row["repeats"]) for row in points],
            [max(row["repeats"]) for row in points],
            color=f"C{index}",
            alpha=0.2,
            lw=0,
        )
        rates.plot(num_envs, medians, label=rate, **style)
        times.plot(num_envs, [row["microseconds_per_step"] for row in points], **style)
    rates.set(title="environment steps per second", ylabel="steps/s")
    times.set(title="time in which all environments make one step", ylabel="µs")
    # Plot the largest memory peak at each number of environments.
    for memory in others:
        peaks: dict[int, float] = {}
        for row in rows:
            peaks[row["num_envs"]] = max(
                peaks.get(row["num_envs"], 0.0), row["peak_device_bytes"] / 2**30
            )
        memory.plot(
            *zip(*sorted(peaks.items()), strict=True), color="0.4", marker="o", markersize=4
        )
        memory.set(title="peak of the device's memory so far", ylabel="GiB")
    # Label the axes.
    for axes in (rates, times, *others):
        _make_readable(axes, sorted({row["num_envs"] for row in rows}))
    rates.legend(loc="best", fontsize="small")
    cores = f", {values['cpu_cores']} cores" if values["platform"] == "cpu" else ""
    device = f"{values['device_count']} x {values['device']}{cores}"
    figure.suptitle(f"{device}, {values['date']}", fontsize=9)
    return figure


def draw(path: Path, values: Mapping[str, Any]) -> Path:
    """Plot the rates of a file into a PNG file beside it.

    Args:
      path: The path of the JSON file.
      values: Its content.

    Returns:
      The path of the PNG file.
    """
    image = path.with_suffix(".png")
    with theme("light"):
        write_bytes(image, to_png(plot_rates(values)))
    return image


def _make_readable(axes: Axes, num_envs: Sequence[int]) -> None:
    axes.set(xlabel="environments", xscale="log", yscale="log")
    axes.set_xticks(num_envs, [f"{count:,}" for count in num_envs], rotation=35, ha="right")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: format_count(value)))
    axes.grid()
    axes.set_axisbelow(True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Plot the rates of the given files.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.

    Raises:
      UserError: A file contains no rates.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="JSON of steps_per_second.py")
    for path in parser.parse_args(arguments).files:
        try:
            print(draw(path, json.loads(path.read_text(encoding="utf-8"))))
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            raise UserError(
                f"{path} contains no rates: give a file that steps_per_second.py wrote"
            ) from None
    return 0


if __name__ == "__main__":
    cli.run_command(main)
