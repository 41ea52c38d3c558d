"""Write the measured tables of the documentation: `python benchmarks/harness/readme_table.py`.

The tables contain the numbers of all files `benchmarks/results/*.json` that `time_to_success.py`,
`steps_per_second.py`, `compare.py` or `adapters.py` wrote; their keys identify them. Each table
stands between two comments, `<!-- NAME: begin ... -->` and `<!-- NAME: end -->`.
"""

import json
import re
import statistics
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import RESULTS, ROOT
from benchmarks.harness.formatting import format_count, format_spread
from jetbot_mjx import cli
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import write_text

_RATES = ("physics", "switched", "env", "rollout", "training", "brax")

Results = Mapping[str, Mapping[str, Any]]
"""The content of each file of results, by the name of the file."""


def read_results(folder: Path) -> Results:
    """Return the content of all files of results, in the order of their names.

    Args:
      folder: The folder of the files.
    """
    return {
        path.name: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(folder.glob("*.json"))
    }


def success_table(results: Results) -> str:
    """Return the times to success: a row for each file of `time_to_success.py` and each start."""
    head = (
        "machine",
        "observation",
        "configuration",
        "trainer",
        "seeds",
        "success",
        "whole process",
        "time to the first training step",
        "time to {target}",
    )
    rows, targets = [], set()
    for values in _robots(results):
        targets.add(values["target"])
        # The oldest files do not say that each start was cold.
        for start in dict.fromkeys(run.get("start", "cold") for run in values["runs"]):
            runs = [run for run in values["runs"] if run.get("start", "cold") == start]
            rows.append(_success_row(values, runs, warm=start == "warm"))
    target = " or ".join(f"{target:.0%}" for target in sorted(targets))
    head = [name.format(target=target) for name in head]
    return _table(head, "llll" + "r" * 5, rows)


def summary_table(results: Results) -> str:
    """Return the times to success from a warm start: a row for each machine and observation.

    Several files of one machine and observation are those of several hosts: their row has the
    range of the medians.
    """
    hosts: dict[tuple[str, str], list[list[Any]]] = {}
    for values in _robots(results):
        runs = [run for run in values["runs"] if run.get("start") == "warm"]
        if runs and values["config"]["trainer"] == "resumable":
            key = _machine(values, runs[0]["versions"]), values["config"]["task"]["observation"]
            hosts.setdefault(key, []).append(runs)
    rows = []
    for (machine, observation), files in hosts.items():
        runs = [run for runs in files for run in runs]
        success = min(run["policy"]["success_rate"] for run in runs)
        times = [[run["target_reached_seconds"] for run in runs] for runs in files]
        time = "not by all"
        if not any(None in one for one in times):
            medians = sorted(times, key=statistics.median)
            time = " to ".join(dict.fromkeys((_seconds(medians[0]), _seconds(medians[-1]))))
        rows.append(
            [machine, f"`{observation}`", f"{success:.2%}", f"{len(runs)}", f"{len(files)}", time]
        )
    head = ("machine", "observation", "success", "seeds", "hosts", "time to 99 %")
    return _table(head, "llrrrr", rows)


def _success_row(values: Mapping[str, Any], runs: Sequence[Any], *, warm: bool) -> list[str]:
    reached = [run["target_reached_seconds"] for run in runs]
    success = min(run["policy"]["success_rate"] for run in runs)
    first = [run.get("first_step_seconds") for run in runs]
    observation = values["config"]["task"]["observation"]
    impl = values["config"]["physics"].get("impl")
    return [
        _machine(values, runs[0]["versions"])
        + (f" beside {values['processor']}" if "processor" in values else "")
        + (", warm cache" if warm else ""),
        f"`{observation}`",
        f"`{values['command'].split('/')[-1]}`",
        values["config"]["trainer"] + (", XLA's physics" if impl == "xla" else ""),
        str(len(runs)),
        f"{success:.2%}",
        _seconds(run["process_seconds"] for run in runs),
        "-" if None in first else _seconds(first),
        "not by all" if None in reached else _seconds(reached),
    ]


def _seconds(times: Iterable[float]) -> str:
    median = statistics.median(times)
    return f"{median:.{1 if median < 10 else 0}f} s"


def best_rates_table(results: Results) -> str:
    """Return the best of each rate with its number of environments: a row for each machine."""
    best: dict[str, dict[str, Any]] = {}
    for values in _files_with(results, "results"):
        found = best.setdefault(_machine(values, values), {})
        for row in values["results"]:
            fastest = found.setdefault(row["rate"], row)
            if row["env_steps_per_second"] > fastest["env_steps_per_second"]:
                found[row["rate"]] = row
    rows = [
        [machine, *(_best(found[rate]) if rate in found else "-" for rate in _RATES)]
        for machine, found in best.items()
    ]
    return _table(["environment steps/s (at num_envs)", *_RATES], "l" + "r" * len(_RATES), rows)


def _best(row: Mapping[str, Any]) -> str:
    return f"{format_count(row['env_steps_per_second'], 3)} ({row['num_envs']:,})"


def rates_tables(results: Results) -> str:
    """Return all rates of all machines, each table below its conditions."""
    head = ("rate", "num_envs", "env_steps_per_second", "physics_steps_per_second")
    head = (*head, "µs/step", "compile", "min .. max", "peak memory")
    parts = []
    for name, values in results.items():
        if not isinstance(values.get("results"), list):
            continue
        rows = [
            [
                row["rate"],
                f"{row['num_envs']:,}",
                f"{row['env_steps_per_second']:,.0f}",
                f"{row['physics_steps_per_second']:,.0f}",
                f"{row['microseconds_per_step']:,.1f}",
                f"{row['compile_seconds']:.1f} s",
                _spread(row),
                _memory(row.get("peak_device_bytes")),
            ]
            for row in values["results"]
        ]
        parts += [_caption(name, values), _table(head, "l" + "r" * 7, rows)]
    for name, values in results.items():
        if "comparison" in values:
            parts += [_caption(name, values), _comparison(values)]
    return "\n\n".join(parts)


def _comparison(values: Mapping[str, Any]) -> str:
    head = ("", "num_envs", "env_steps_per_second", "busy cores", "min .. max")
    rows = [
        [
            row["rate"],
            f"{row['num_envs']:,}",
            f"{row['env_steps_per_second']:,.0f}",
            f"{statistics.median(row['busy_cores']):.2f}",
            _spread(row),
        ]
        for row in values["comparison"]
    ]
    table = _table(head, "lrrrr", rows)
    units = ("", "second"), ("_per_core", "second of processor time")
    for other in ("mujoco", "warp"):
        sentences = []
        for key, unit in units:
            if ratios := values.get(f"physics_over_{other}{key}"):
                ends = f"{min(ratios):.2f} .. {max(ratios):.2f}"
                sentences.append(f"{statistics.median(ratios):.2f} ({ends}) per {unit}")
        if sentences:
            table += (
                f"\n\n`physics` over `{other}`, each at its best, median over rounds:"
                f" {', '.join(sentences)}."
            )
    return table


def adapters_table(results: Results) -> str:
    """Return the rates of the adapters, each table below its conditions."""
    head = ("", "robots", "steps/s", "per second of processor time", "min .. max")
    parts = []
    for name, values in results.items():
        if "adapters" not in values:
            continue
        rows = [
            [
                f"`{row['rate']}`",
                f"{row['num_envs']:,}",
                format_count(row["env_steps_per_second"], 3),
                format_count(row["env_steps_per_second"] / statistics.median(row["busy_cores"]), 3),
                _spread(row),
            ]
            for row in values["adapters"]
        ]
        packages, repeats = values["versions"]["packages"], values["conditions"]["repeats"]
        machine = f"{_machine(values, values)}, JAX {packages['jax']}, MuJoCo {packages['mujoco']}"
        parts += [f"`{name}`: {machine}, median of {repeats}", _table(head, "lrrrr", rows)]
    return "\n\n".join(parts)


def _caption(name: str, values: Mapping[str, Any]) -> str:
    packages = values["versions"]["packages"]
    physics = values["config"]["physics"].get("impl")
    return (
        f"`{name}`: {_machine(values, values)}, {values['date']}, JAX {packages['jax']}, MuJoCo"
        f" {packages['mujoco']}, Brax {packages['brax']}"
        + (f", `physics.impl: {physics}`" if physics else "")
        + f", median of {values['conditions']['repeats']} repeats"
    )


def _spread(row: Mapping[str, Any]) -> str:
    return format_spread(row["env_steps_per_second"], row["repeats"])


def _memory(size: int | None) -> str:
    return "-" if size is None else f"{size / 2**20:,.0f} MiB"


def _machine(values: Mapping[str, Any], device: Mapping[str, Any]) -> str:
    if device["device"] == "cpu":
        return f"{values['cpu_cores']} CPU cores"
    return f"{device['device_count']} {device['device']}"


def _robots(results: Results) -> list[Mapping[str, Any]]:
    """Return the files of `time_to_success.py` about robots, not about other environments."""
    files = _files_with(results, "runs")
    return [values for values in files if values["config"].get("environment") is None]


def _files_with(results: Results, key: str) -> list[Mapping[str, Any]]:
    return [values for values in results.values() if isinstance(values.get(key), list)]


def _table(head: Sequence[str], alignment: str, rows: Sequence[Sequence[str]]) -> str:
    rule = ["---" if side == "l" else "--:" for side in alignment]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rule, *rows))


BLOCKS: Mapping[str, Mapping[str, Callable[[Results], str]]] = {
    "README.md": {"summary": summary_table},
    "docs/index.md": {"summary": summary_table},
    "docs/results.md": {"success": success_table, "rates": best_rates_table},
    "benchmarks/README.md": {"results": rates_tables},
    "docs/from-the-tutorial.md": {"adapters": adapters_table},
}
"""The function that makes each table, by file and by the name of its block."""


def with_tables(text: str, name: str, results: Results) -> str:
    """Return the text of a file with its tables replaced.

    Args:
      text: The text of the file.
      name: The name of the file in `BLOCKS`.
      results: The output of `read_results`.

    Raises:
      UserError: The comments around a block are missing.
    """
    for block, make in BLOCKS[name].items():
        pattern = rf"(<!-- {block}: begin[^>]*-->\n).*?(<!-- {block}: end -->)"
        found = re.search(pattern, text, flags=re.DOTALL)
        if found is None:
            raise UserError(f"{name} has no <!-- {block}: begin --> and <!-- {block}: end -->")
        text = f"{text[: found.start()]}{found[1]}{make(results)}\n{found[2]}{text[found.end() :]}"
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the tables into the files.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.
    """
    cli.Parser(description=__doc__).parse_args(arguments)
    results = read_results(RESULTS)
    for name in BLOCKS:
        path = ROOT / name
        before = path.read_text(encoding="utf-8")
        after = with_tables(before, name, results)
        if after != before:
            write_text(path, after)
        print(f"{name}: {'written' if after != before else 'unchanged'}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
