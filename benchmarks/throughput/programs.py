"""Run small JAX programs as one kernel and by XLA: `python benchmarks/throughput/programs.py`.

The programs are of the kinds that users of JAX report as slow, each with the link of the report.
They are written anew, in float32, with the sizes and the number of instances of the reports, where
these are known and one kernel allows them. These differ:

- The reports of `quasiseparable_cholesky`, `mass_matrix`, `neuron` and `orbits` compute in float64.
  The first says that float32 is not slow.
- `mass_matrix` has 35 joints in its report, which are more than 100,000 operations here.
- `scalar_nodes`, `neuron` and `orbits` are differentiated in theirs, as in `scalar_nodes_gradient`
  and `neuron_gradient` here.
- `search` has a table of 2²² numbers in its report, which is closed: XLA has become fast.
- `orbits` takes leapfrog steps in place of Kepler's motion.

Each runs for as many instances as in its report and for 256, by `jax.vmap`, unless
`--num-instances` names others. Both ways are timed in turn in every round. A time is that of the
shortest call of a round, and the median of all rounds: other programs on the machine change it
little. `ratio` is the time of XLA divided by that of the kernel, and `difference` how far apart
their results are, relative to the largest number.

For a single instance, `bound` is a time that no program goes below: a call that does nothing, and
the longest chain of operations that need one another (`longest_chain.py` says what it assumes).
XLA's time divided by it is the largest ratio that is possible, `at most`.

Each program is measured in a process of its own, which `--limit` ends: XLA may wait for itself for
ever, where LAPACK's functions take all of its threads.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.processes import last_within
from benchmarks.harness.results import check_output, counts, write
from benchmarks.harness.timing import available_cores, warm_up
from benchmarks.throughput.longest_chain import lower_bound, measure_times
from jetbot_mjx import cli
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import versions
from onekernel import UnsupportedError, fuse

# Gaussian processes.


def quasiseparable_cholesky(noise: Float[Array, "n"]) -> Float[Array, "n 4"]:
    """Factorise the covariance of a time series, whose state has three numbers (a Matérn kernel).

    Args:
      noise: variance of each observation.

    Returns:
      For each observation the diagonal element of the factor, and the generators of its row.
    """
    step = 0.1
    moves = jnp.array([[1.0, step, step**2 / 2], [-step, 1.0 - step, step], [0.02, -step, 0.9]])
    observed, start = jnp.array([1.0, 0.1, 0.01]), jnp.diag(jnp.array([1.0, 0.5, 0.25]))

    def one(covariance: Array, noise: Array) -> tuple[Array, Array]:
        projected = covariance @ observed
        diagonal = jnp.sqrt(observed @ start @ observed + noise - observed @ projected)
        row = (start @ observed - moves @ projected) / diagonal
        following = moves @ covariance @ moves.T + jnp.outer(row, row)
        return 0.5 * following, jnp.concatenate([diagonal[None], row])

    return jax.lax.scan(one, jnp.zeros((3, 3)), noise)[1]


def small_solves(system: Float[Array, "3 4"]) -> Float[Array, "3 4"]:
    """Differentiate the solution of three equations.

    Args:
      system: the matrix, and the right side as the last column.

    Returns:
      The gradient of the solution's sum.
    """
    return jax.grad(lambda x: jnp.linalg.solve(x[:, :3], x[:, 3]).sum())(system)


def draw_systems(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw systems of equations with positive definite matrices."""
    factor = rng.standard_normal((*shape[:-1], 3))
    matrix = factor @ np.swapaxes(factor, -1, -2) + 1e-2 * np.eye(3)
    right = rng.standard_normal((*shape[:-1], 1))
    return np.concatenate([matrix, right], -1).astype(np.float32)


# Models with many single numbers.


def scalar_nodes(observed: Float[Array, "t"]) -> dict[str, Float[Array, ""]]:
    """Filter a signal by a chain of 30 nodes, whose means and precisions are single numbers.

    Args:
      observed: the signal.

    Returns:
      Mean and precision of each node at the end.
    """
    names = [f"node{i}" for i in range(30)]
    first = {f"{name}.{kind}": jnp.float32(1.0) for name in names for kind in ("mean", "precision")}

    def one(nodes: dict[str, Array], signal: Array) -> tuple[dict[str, Array], None]:
        after, error = dict(nodes), signal - nodes["node0.mean"]
        for i, name in enumerate(names):
            mean, precision = nodes[f"{name}.mean"], nodes[f"{name}.precision"]
            predicted = 1.0 / (1.0 / precision + jnp.exp(-0.1 * mean - 0.1 * i))
            after[f"{name}.precision"] = predicted + 0.5
            after[f"{name}.mean"] = mean + 0.5 / after[f"{name}.precision"] * jnp.tanh(error)
            error = 0.5 * error * predicted
        return after, None

    return jax.lax.scan(one, first, observed)[0]


def gradient(function: Callable[[Array], PyTree]) -> Callable[[Array], Array]:
    """Return the gradient of the sum of squares of all that a function returns."""

    def loss(x: Array) -> Array:
        squares = [jnp.square(y).sum() for y in jax.tree.leaves(function(x))]
        return jnp.stack(squares).sum()

    return jax.grad(loss)


def search(start: Int[Array, ""]) -> Int[Array, ""]:
    """Go through a table until its largest number has been seen."""
    table = jnp.asarray(np.arange(2**14, dtype=np.int32))
    stop = table[-1]
    after = jax.lax.while_loop(
        lambda x: x[0] < stop, lambda x: (jnp.maximum(x[0], table[x[1]]), x[1] + 1), (start, start)
    )
    return after[1]


# Simulations.


def mass_matrix(angles: Float[Array, "joints"]) -> Float[Array, "joints joints"]:
    """Compute the mass matrix of an arm by the Jacobians of all links."""
    joints = len(angles)
    offset = jnp.array([0.1, 0.02, 0.0])

    def turned(angle: Array, is_odd: int) -> Array:
        c, s, one, none = jnp.cos(angle), jnp.sin(angle), jnp.ones(()), jnp.zeros(())
        rows = (
            ((one, none, none), (none, c, -s), (none, s, c))
            if is_odd
            else ((c, -s, none), (s, c, none), (none, none, one))
        )
        return jnp.stack([jnp.stack(row) for row in rows])

    frame, place = jnp.eye(3), jnp.zeros(3)
    axes, places, centres = [], [], []
    for i in range(joints):
        axes.append(frame[:, 0 if i % 2 else 2])
        places.append(place)
        frame = frame @ turned(angles[i], i % 2)
        centres.append(place + frame @ (0.5 * offset))
        place = place + frame @ offset
    matrix = jnp.zeros((joints, joints))
    for i in range(joints):
        velocities = [
            jnp.cross(a, centres[i] - p) for a, p in zip(axes[: i + 1], places, strict=False)
        ]
        linear = jnp.stack([*velocities, *[jnp.zeros(3)] * (joints - i - 1)], 1)
        turns = jnp.stack([*axes[: i + 1], *[jnp.zeros(3)] * (joints - i - 1)], 1)
        matrix += 0.5 * linear.T @ linear + 1e-3 * turns.T @ turns
    return matrix


def neuron(current: Float[Array, "t"]) -> Float[Array, "t"]:
    """Simulate a cable of eight compartments with Hodgkin's and Huxley's channels.

    Args:
      current: current into the first compartment [µA/cm²], for steps of 0.025 ms.
      scan: `jax.lax.scan` or `scan_in_groups`.

    Returns:
      The voltage of the last compartment [mV].
    """
    count, dt, axial = 8, 0.025, 2.0

    def rates(v: Array) -> tuple[tuple[Array, Array], ...]:
        def ratio(x: Array) -> Array:
            return jnp.where(jnp.abs(x) < 1e-4, 1.0, x / -jnp.expm1(-x))

        return (
            (ratio((v + 40) / 10), 4 * jnp.exp(-(v + 65) / 18)),
            (0.07 * jnp.exp(-(v + 65) / 20), 1 / (1 + jnp.exp(-(v + 35) / 10))),
            (0.1 * ratio((v + 55) / 10), 0.125 * jnp.exp(-(v + 65) / 80)),
        )

    def one(state: tuple[Array, ...], into: Array) -> tuple[tuple[Array, ...], Array]:
        v, *gates = state
        opened = []
        for gate, (opens, closes) in zip(gates, rates(v), strict=True):
            limit = opens / (opens + closes)
            opened.append(limit + (gate - limit) * jnp.exp(-dt * (opens + closes)))
        m, h, n = opened
        sodium, potassium, leak = 120 * m**3 * h, 36 * n**4, 0.3
        reversal = sodium * 50 - potassium * 77 - leak * 54.4
        # The implicit step is a tridiagonal system, solved from one end to the other and back.
        diagonal = 1 + dt * (sodium + potassium + leak + axial * jnp.array([1, *[2] * 6, 1]))
        right = v + dt * (reversal + into * jnp.zeros(count).at[0].set(1.0))
        for i in range(1, count):
            factor = -dt * axial / diagonal[i - 1]
            diagonal = diagonal.at[i].add(factor * dt * axial)
            right = right.at[i].add(-factor * right[i - 1])
        after = [right[-1] / diagonal[-1]]
        for i in reversed(range(count - 1)):
            after.append((right[i] + dt * axial * after[-1]) / diagonal[i])
        v = jnp.stack(after[::-1])
        return (v, *opened), v[-1]

    rest = jnp.full(count, -65.0), jnp.full(count, 0.05), jnp.full(count, 0.6), jnp.full(count, 0.3)
    return jax.lax.scan(one, rest, current)[1]


def orbits(velocities: Float[Array, "planets 3"]) -> Float[Array, "planets 3"]:
    """Integrate a star's planets for 2,795 steps by leapfrog.

    Args:
      velocities: changes of the circular orbits' velocities, as parts of them.

    Returns:
      The positions, in units in which the innermost planet goes round in 2π.
    """
    count = len(velocities)
    radii = jnp.arange(1, count + 1, dtype=jnp.float32)
    places = jnp.stack([radii, jnp.zeros(count), jnp.zeros(count)], 1)
    speeds = radii[:, None] ** -0.5 * (jnp.array([0.0, 1.0, 0.0]) + velocities)

    def pull(x: Array) -> Array:
        between = x[:, None] - x[None]
        cubed = ((between**2).sum(-1) + 1e-6) ** 1.5
        planets = -(1e-3 * between / cubed[..., None]).sum(1)
        return planets - x / ((x**2).sum(-1, keepdims=True) ** 1.5)

    def one(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        x, v = state
        v = v + 0.005 * pull(x)
        x = x + 0.01 * v
        return x, v + 0.005 * pull(x)

    return jax.lax.fori_loop(0, 2795, one, (places, speeds))[0]


class Program(NamedTuple):
    """A `Program` is a function of one instance, and what asked for it."""

    function: Callable[[Array], PyTree]
    shape: tuple[int, ...]
    """Shape of its argument."""
    report: str
    """Address of the report, below github.com."""
    draw: Callable[[np.random.Generator, tuple[int, ...]], np.ndarray] = lambda rng, shape: (
        0.1 * rng.standard_normal(shape)
    ).astype(np.float32)
    """Draws its argument, for all instances."""
    num_instances: int = 1
    """Number of instances in the report."""


def draw_currents(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw currents into a neuron [µA/cm²]."""
    return np.full(shape, 20.0, np.float32) + rng.random(shape, np.float32)


PROGRAMS = {
    "quasiseparable_cholesky": Program(
        quasiseparable_cholesky,
        (2000,),
        "jax-ml/jax/issues/36799",
        lambda rng, shape: rng.uniform(0.1, 0.2, shape).astype(np.float32),
    ),
    "small_solves": Program(
        small_solves, (3, 4), "jax-ml/jax/issues/36927", draw_systems, 182 * 474
    ),
    "scalar_nodes": Program(scalar_nodes, (614,), "jax-ml/jax/issues/40150"),
    "scalar_nodes_gradient": Program(gradient(scalar_nodes), (614,), "jax-ml/jax/issues/40150"),
    "neuron": Program(neuron, (1000,), "jax-ml/jax/issues/26145", draw_currents),
    "neuron_gradient": Program(gradient(neuron), (1000,), "jax-ml/jax/issues/26145", draw_currents),
    "mass_matrix": Program(mass_matrix, (20,), "jax-ml/jax/issues/26021"),
    "search": Program(
        search,
        (),
        "jax-ml/jax/issues/25190",
        lambda rng, shape: rng.integers(0, 8, shape, np.int32),
    ),
    "orbits": Program(orbits, (3, 3), "kemasuda/jnkepler/issues/18"),
}


class Row(NamedTuple):
    """A `Row` holds the times of one program; None: not measured."""

    program: str
    report: str
    num_instances: int
    kernel_seconds: float | None = None
    """Time of the shortest call of a round, median of the rounds."""
    xla_seconds: float | None = None
    bound_seconds: float | None = None
    """Time that no program goes below, for a single instance."""
    kernel_compile_seconds: float | None = None
    xla_compile_seconds: float | None = None
    difference: float | None = None
    """Largest difference of a result, relative to the largest number of it."""
    note: str = ""
    """Why there is no kernel, or what took too long."""


class Compiled:
    """A function that JAX has compiled for an argument, with the time that took."""

    def __init__(self, function: Callable[[Array], PyTree], argument: Array) -> None:
        """Compile a function, and warm it up."""
        start = time.perf_counter()
        self._program = jax.jit(function).lower(argument).compile()
        self.compile_seconds = time.perf_counter() - start
        self._argument = argument
        self._calls = warm_up(self._time_calls)

    def repeat(self) -> float:
        """Return the time of a call [s] in one round."""
        return self._time_calls(self._calls) / self._calls

    def shortest(self) -> float:
        """Return the time of the shortest call in one round [s]."""
        return min(self._time_calls(1) for _ in range(self._calls))

    def results(self) -> list[np.ndarray]:
        """Return the leaves of the result, in float64."""
        leaves = jax.tree.leaves(self._program(self._argument))
        return [np.asarray(x, np.float64) for x in leaves]

    def _time_calls(self, calls: int) -> float:
        start = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(self._program(self._argument))
        return time.perf_counter() - start


def measure(name: str, num_instances: int, rounds: int) -> Iterator[Row]:
    """Time a program both ways.

    Args:
      name: a key of `PROGRAMS`.
      num_instances: number of instances; 1: without `jax.vmap`.
      rounds: number of rounds, in each of which both are timed once.

    Yields:
      The row, without what XLA takes and then with it.
    """
    function, shape, report, draw, _ = PROGRAMS[name]
    rng, is_one = np.random.default_rng(0), num_instances == 1
    argument = jnp.asarray(draw(rng, shape if is_one else (num_instances, *shape)))
    batch = (lambda f: f) if is_one else jax.vmap
    row, kernel = Row(name, f"https://github.com/{report}", num_instances), None
    try:
        kernel = Compiled(batch(fuse(function, on_unsupported="raise")), argument)
        row = row._replace(
            kernel_seconds=statistics.median(kernel.shortest() for _ in range(rounds)),
            kernel_compile_seconds=kernel.compile_seconds,
            bound_seconds=lower_bound(function, argument, measure_times()) if is_one else None,
        )
    except UnsupportedError as error:
        row = row._replace(note=str(error))
    yield row
    xla = Compiled(batch(function), argument)
    times: dict[str, list[float]] = {"xla": [], "kernel": []}
    for _ in range(rounds):
        times["xla"].append(xla.shortest())
        if kernel:
            times["kernel"].append(kernel.shortest())
    row = row._replace(
        xla_seconds=statistics.median(times["xla"]), xla_compile_seconds=xla.compile_seconds
    )
    if kernel:
        pairs = zip(kernel.results(), xla.results(), strict=True)
        row = row._replace(
            kernel_seconds=statistics.median(times["kernel"]),
            difference=max(
                float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-12)) for a, b in pairs
            ),
        )
    yield row


def measure_within(limit: float, name: str, num_instances: int, rounds: int) -> Row:
    """Return the row of `measure`, or what there is of it after so many seconds.

    Raises:
      UserError: the process that measures failed.
    """
    row, is_complete = last_within(limit, measure, name, num_instances, rounds)
    if row is None:
        row = Row(name, f"https://github.com/{PROGRAMS[name].report}", num_instances)
    if is_complete:
        return row
    is_begun = row.kernel_seconds is not None or row.note
    late = f"{'XLA' if is_begun else 'the kernel'}: not within {limit:g} s"
    return row._replace(note="; ".join(filter(None, (row.note, late))))


_HEAD = (
    f"{'program':26}{'instances':>10}{'kernel':>13}{'XLA':>13}{'ratio':>8}{'bound':>12}"
    f"{'at most':>9}{'compiled in':>13}{'XLA':>8}{'difference':>12}"
)


def table_line(row: Row) -> str:
    """Return a row of the printed table."""

    def text(x: float | None, form: str, unit: str = "") -> str:
        return "-" if x is None else f"{x:{form}}{unit}"

    def microseconds(x: float | None) -> str:
        return text(None if x is None else 1e6 * x, ",.1f", " us")

    def ratio(to: float | None) -> str:
        return text(row.xla_seconds / to if row.xla_seconds and to else None, ".1f")

    kernel, xla, bound = row.kernel_seconds, row.xla_seconds, row.bound_seconds
    return (
        f"{row.program:26}{row.num_instances:10,}{microseconds(kernel):>13}{microseconds(xla):>13}"
        f"{ratio(kernel):>8}{microseconds(bound):>12}{ratio(bound):>9}"
        f"{text(row.kernel_compile_seconds, '.1f', ' s'):>13}"
        f"{text(row.xla_compile_seconds, '.1f', ' s'):>8}{text(row.difference, '.0e'):>12}"
        f"{'  ' + row.note if row.note else ''}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, measure, print a table and write a file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = list(PROGRAMS)
    parser.add_argument(
        "programs", nargs="*", default=names, metavar="NAME", help=f"of {', '.join(names)}"
    )
    parser.add_argument(
        "--num-instances",
        type=counts,
        metavar="N[,N...]",
        help="(default: as many as in the report, and 256)",
    )
    parser.add_argument("--rounds", type=cli.positive_int, default=5)
    parser.add_argument(
        "--limit",
        type=cli.positive_int,
        default=180,
        metavar="SECONDS",
        help="the longest time to measure a program (default: 180)",
    )
    parser.add_argument("--output", type=Path, help="a JSON file for the results")
    options = parser.parse_args(arguments)
    for name in options.programs:
        if name not in PROGRAMS:
            raise UserError(f"there is no program {name}: choose of {', '.join(names)}")
    if options.output:
        check_output(options.output)
    device = jax.devices()[0]
    print(f"{device.device_kind}, {available_cores()} cores")
    print(_HEAD)
    rows = []
    for name in options.programs:
        for count in options.num_instances or (PROGRAMS[name].num_instances, 256):
            rows.append(measure_within(options.limit, name, count, options.rounds))
            print(table_line(rows[-1]), flush=True)
    if options.output:
        about = {"device": device.device_kind, "cpu_cores": available_cores()}
        about |= {"versions": versions(), "rows": [row._asdict() for row in rows]}
        write(options.output, about)
        print(f"wrote {options.output}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
