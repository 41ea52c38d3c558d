"""Solve an ensemble of differential equations: `python benchmarks/throughput/ensembles.py`.

  kernel   an adaptive solver of this file, as one kernel by `onekernel.fuse`
  xla      the same function, compiled by XLA
  diffrax  `diffrax.diffeqsolve` with the same method and tolerances, under `jax.vmap`; left out if
           diffrax is not installed

Every instance integrates the Lorenz system from a start of its own, with steps of its own. The
method is Tsitouras' pair of orders 5 and 4. The contenders are timed in turn in every round. The
last columns say how many steps an instance takes, and how far its end is from that of the same
method with steps of 1e-3 in float64 (median; the system is chaotic).

Source of the method: C. Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only the first column
simplifying assumption, Computers & Mathematics with Applications 62 (2011).
"""

import argparse
import importlib.util
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.formatting import format_count, format_spread
from benchmarks.harness.results import check_output, write
from benchmarks.harness.timing import available_cores
from benchmarks.throughput.programs import Compiled
from jetbot_mjx import cli
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import versions
from onekernel import fuse

END = 5.0
"""Time until which the system is integrated."""

_STAGES = (
    (0.161,),
    (-0.008480655492356989, 0.335480655492357),
    (2.8971530571054935, -6.359448489975075, 4.3622954328695815),
    (5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525),
    (
        *(5.86145544294642, -12.92096931784711, 8.159367898576159),
        *(-0.071584973281401, -0.028269050394068383),
    ),
    (
        *(0.09646076681806523, 0.01, 0.4798896504144996),
        *(1.379008574103742, -3.290069515436081, 2.324710524099774),
    ),
)
"""Weights of the slopes in each stage; the last stage is the step of order 5."""

_ERROR = (
    *(-0.00178001105222577714, -0.0008164344596567469, 0.007880878010261995),
    *(-0.1447110071732629, 0.5823571654525552, -0.45808210592918697, 0.015151515151515152),
)
"""Weights of the slopes in the difference to the step of order 4."""

_MOST_STEPS = 4096
_SAFETY, _MIN_FACTOR, _MAX_FACTOR = 0.9, 0.2, 10.0
_FIRST_STEP = 0.01


def lorenz(state: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the derivative of the Lorenz system by time."""
    x, y, z = state
    return jnp.stack([10.0 * (y - x), x * (28.0 - z) - y, x * y - 8.0 / 3.0 * z])


def one_step(
    y: Float[Array, "3"], slope: Float[Array, "3"], step: Float[Array, ""]
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """Make one step.

    Args:
      y: the state.
      slope: its derivative.
      step: the length of the step.

    Returns:
      The next state, its derivative, and the estimated error of the next state.
    """
    slopes = [slope]
    after = y
    for weights in _STAGES:
        after = y + step * sum(w * k for w, k in zip(weights, slopes, strict=True))
        slopes.append(lorenz(after))
    error = step * sum(w * k for w, k in zip(_ERROR, slopes, strict=True))
    return after, slopes[-1], error


def solve(start: Float[Array, "3"], tolerance: float) -> tuple[Float[Array, "3"], Int[Array, ""]]:
    """Integrate from a start until `END`, with steps that the estimated error chooses.

    Args:
      start: the state at time 0.
      tolerance: relative and absolute tolerance of a step.

    Returns:
      The state at the end, and the number of steps, with those that were repeated.
    """

    def goes_on(carry: tuple[Array, ...]) -> Array:
        time, *_, count = carry
        return (time < END) & (count < _MOST_STEPS)

    def advance(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        time, y, slope, step, count = carry
        # The last step ends at the end.
        now = jnp.minimum(step, END - time)
        after, after_slope, error = one_step(y, slope, now)
        scale = tolerance * (1.0 + jnp.maximum(jnp.abs(y), jnp.abs(after)))
        norm = jnp.sqrt(jnp.mean(jnp.square(error / scale)))
        accepted = norm < 1.0
        # The error of a step grows with the fifth power of its length.
        factor = _SAFETY * jnp.maximum(norm, 1e-10) ** -0.2
        following = now * jnp.clip(factor, _MIN_FACTOR, jnp.where(accepted, _MAX_FACTOR, 1.0))
        return (
            jnp.where(accepted, jnp.where(now < step, END, time + now), time),
            jnp.where(accepted, after, y),
            jnp.where(accepted, after_slope, slope),
            following,
            count + 1,
        )

    first = jnp.float32(0), start, lorenz(start), jnp.float32(_FIRST_STEP), jnp.int32(0)
    _, end, _, _, count = jax.lax.while_loop(goes_on, advance, first)
    return end, count


def by_diffrax(tolerance: float) -> Callable[[Float[Array, "3"]], tuple[Array, Array]]:
    """Return the same integration by diffrax."""
    import diffrax  # pyright: ignore[reportMissingImports]

    def integrate(start: Float[Array, "3"]) -> tuple[Array, Array]:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: lorenz(y)),
            diffrax.Tsit5(),
            0.0,
            END,
            _FIRST_STEP,
            start,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=_MOST_STEPS,
        )
        return solution.ys[0], solution.stats["num_steps"]

    return integrate


def exact(starts: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the ends in float64, by many small steps."""
    y, step = starts.astype(np.float64).T, 1e-3

    def slope(y: np.ndarray) -> np.ndarray:
        a, b, c = y
        return np.stack([10.0 * (b - a), a * (28.0 - c) - b, a * b - 8.0 / 3.0 * c])

    for _ in range(round(END / step)):
        slopes = [slope(y)]
        for weights in _STAGES:
            after = y + step * sum(w * k for w, k in zip(weights, slopes, strict=True))
            slopes.append(slope(after))
        y = after
    return y.T


class Row(NamedTuple):
    """A `Row` holds the rate of one contender."""

    contender: str
    instances_per_second: float
    """Median of the rounds."""
    repeats: list[float]
    """`instances_per_second` of each round."""
    compile_seconds: float
    mean_steps: float
    """Steps of an instance, with those that were repeated."""
    median_error: float
    """Largest difference of a coordinate to the exact end."""


def measure(count: int, tolerance: float, rounds: int) -> list[Row]:
    """Time all contenders.

    Args:
      count: number of instances.
      tolerance: relative and absolute tolerance of a step.
      rounds: number of rounds, in each of which every contender is timed once.
    """
    starts = np.random.default_rng(0).normal((0.0, 0.0, 25.0), 5.0, (count, 3)).astype(np.float32)

    def one(start: Array) -> tuple[Array, Array]:
        return solve(start, tolerance)

    functions = {"kernel": fuse(one, on_unsupported="raise"), "xla": one}
    if importlib.util.find_spec("diffrax"):
        functions["diffrax"] = by_diffrax(tolerance)
    else:
        print("diffrax is not installed: pip install diffrax")
    argument = jnp.asarray(starts)
    contenders = {name: Compiled(jax.vmap(f), argument) for name, f in functions.items()}
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, contender in contenders.items():
            rates[name].append(count / contender.repeat())
    ends, rows = exact(starts[:256]), []
    for name, contender in contenders.items():
        end, steps = contender.results()
        error = float(np.median(np.abs(end[:256] - ends).max(axis=1)))
        rate, seconds = statistics.median(rates[name]), contender.compile_seconds
        rows.append(Row(name, rate, rates[name], seconds, float(steps.mean()), error))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, measure, print a table and write a file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--num-instances", type=cli.positive_int, help="(default: 1,000,000, CPU: 4,096)"
    )
    parser.add_argument("--tolerance", type=float, default=1e-5, help="(default: 1e-5)")
    parser.add_argument("--rounds", type=cli.positive_int, default=5)
    parser.add_argument("--output", type=Path, help="a JSON file for the results")
    options = parser.parse_args(arguments)
    if not 1e-7 <= options.tolerance < 1:
        raise UserError(f"--tolerance {options.tolerance}: name a number from 1e-7 to 1")
    if options.output:
        check_output(options.output)
    device = jax.devices()[0]
    count = options.num_instances or (1_000_000 if device.platform == "gpu" else 4096)
    rows = measure(count, options.tolerance, options.rounds)
    print(f"{device.device_kind}, {available_cores()} cores, {count:,} instances")
    print(
        f"{'contender':10}{'instances/s':>13}{'min .. max':>19}"
        f"{'compile':>10}{'steps':>8}{'error':>9}"
    )
    for row in rows:
        rate = row.instances_per_second
        print(
            f"{row.contender:10}{format_count(rate, 4):>13}{format_spread(rate, row.repeats):>19}"
            f"{row.compile_seconds:>8.1f} s{row.mean_steps:>8.1f}{row.median_error:>9.0e}"
        )
    if options.output:
        about = {"device": device.device_kind, "cpu_cores": available_cores()}
        about |= {"num_instances": count, "tolerance": options.tolerance, "versions": versions()}
        write(options.output, {**about, "rows": [row._asdict() for row in rows]})
        print(f"wrote {options.output}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
