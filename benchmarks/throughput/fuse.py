"""Step any MuJoCo model as one kernel, by MJX through XLA, and by C MuJoCo.

    python benchmarks/throughput/fuse.py hopper chain:14 my_robot.xml

  kernel   `onekernel.mujoco.fuse_mjx`
  mjx      `mjx.step`, compiled by XLA in a process of its own; left out if that takes too long
  warp     MJX-Warp (`pip install warp-lang`, at the version that MJX requires), likewise; it needs
           an NVIDIA GPU
  rollout  C MuJoCo's threaded `mujoco.rollout`, one thread per core
  batch    C MuJoCo's threaded `mujoco.batch`, one thread per core

All make the same environment steps: `--n-substeps` physics steps under constant controls, which are
drawn before the timing starts, from the same states. Each call begins again from these states, in
which the instances have moved under random controls for up to a hundred physics steps. The
contenders are timed in turn in every round. `cpu/step` is the processor time of all threads for an
environment step of one instance: where other programs run beside the benchmark, compare the
contenders for CPUs by it. The last columns say how far the positions and
velocities after one environment step are from those of C MuJoCo in double precision, whose solver
may make 1,000 iterations, and from those of MJX, relative to the largest of them.

The solver stops as the model's options say. A tolerance of 1e-8, MuJoCo's default, is below what
float32 can show, so that MJX iterates on where nothing changes any more: `--tolerance 1e-6`.
"""

import argparse
import contextlib
import copy
import importlib.util
import math
import multiprocessing
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from mujoco import mjx

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.formatting import format_count, format_spread
from benchmarks.harness.results import check_output, write
from benchmarks.harness.timing import available_cores, warm_up
from jetbot_mjx import cli
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.plots import theme, to_png
from jetbot_mjx.runs.run_dir import versions, write_bytes
from onekernel import UnsupportedError
from onekernel.mujoco import FusedMjx, MjxState, fuse_mjx

GYMNASIUM = (
    *("inverted_pendulum", "inverted_double_pendulum", "reacher", "swimmer", "hopper"),
    *("walker2d", "half_cheetah", "ant"),
)
"""Models of Gymnasium that are measured unless others are named."""

PACKAGES = {
    **{name: f"gymnasium/envs/mujoco/assets/{name}.xml" for name in (*GYMNASIUM, "humanoid")},
    "cartpole_balance": "mujoco_playground/_src/dm_control_suite/xmls/cartpole.xml",
    "quadruped": "dm_control/suite/quadruped.xml",
}
"""Where packages have the models that are known by name."""

INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}

SOLVERS = {"CG": mujoco.mjtSolver.mjSOL_CG, "Newton": mujoco.mjtSolver.mjSOL_NEWTON}

_DISTINCT = 1024
"""Most states that are different from each other; more instances begin from copies of them."""
_MOST_STEPS = 100
"""Most physics steps by which a state is older than the model's first one."""
_ROBOTS_PER_CORE = 256
"""Most instances per core of C MuJoCo."""
_MOST_IN_MEMORY = {"mjx": 8192, "warp": 32_768}
"""Most instances of those that keep all of MJX's data of an instance in memory; from about there
on, more of them are not faster."""

Moved = tuple[Float[np.ndarray, "n nq"], Float[np.ndarray, "n nv"]]
"""Positions and velocities of the instances after one environment step."""


class Settings(NamedTuple):
    """A `Settings` holds what a contender needs to know; other processes receive it."""

    name: str
    """A model of Gymnasium, `chain:LINKS`, or the path of an MJCF."""
    integrator: str
    """A key of `INTEGRATORS`, or `own` for the model's."""
    solver: tuple[tuple[str, float], ...]
    """Options of the solver by their names in `mujoco.MjOption`; others are the model's."""
    num_envs: int
    n_substeps: int
    unroll: int
    """Environment steps in a call."""


class Row(NamedTuple):
    """A `Row` holds the rate of one contender with one model."""

    model: str
    nv: int
    """Degrees of freedom."""
    contender: str
    num_envs: int
    env_steps_per_second: float | None
    """Median of the rounds; None: it did not compile within the limit."""
    cpu_seconds: float | None
    """Processor time of all threads for one environment step of one instance, the median of the
    rounds [s]; other programs on the machine change it little. None: a GPU makes the steps."""
    compile_seconds: float | None
    """Time of tracing, lowering and compiling [s]; C MuJoCo has none."""
    repeats: list[float]
    """`env_steps_per_second` of each round."""
    from_mujoco: float | None
    """Difference to C MuJoCo after one environment step; None: not measured."""
    from_mjx: float | None
    """Difference to MJX through XLA after one environment step; None: not measured."""
    note: str
    """Why there is no rate, or no kernel."""


class Problem:
    """A `Problem` holds a model, and the states and controls from which contenders step it."""

    def __init__(self, settings: Settings) -> None:
        """Load the model, and move the instances to their states."""
        self.settings, self.model = settings, load_model(settings.name)
        if settings.integrator != "own":
            self.model.opt.integrator = INTEGRATORS[settings.integrator]
        for option, value in settings.solver:
            setattr(self.model.opt, option, value)
        model = self.model
        # Two generators: states and controls of the first instances do not depend on how many there
        # are, nor on each other.
        rng, rng_of_states = np.random.default_rng(0), np.random.default_rng(1)
        shape = settings.num_envs, settings.unroll, model.nu
        low, high = model.actuator_ctrlrange.T
        limited = model.actuator_ctrllimited.astype(bool)
        self.controls = rng.uniform(
            np.where(limited, low, -1.0), np.where(limited, high, 1.0), shape
        ).astype(np.float32)
        """Controls of each instance in each environment step of a call."""
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        data = mujoco.MjData(model)
        states = np.zeros((min(settings.num_envs, _DISTINCT), mujoco.mj_stateSize(model, kind)))
        self.warmstarts = np.zeros((len(states), model.nv), np.float32)
        for i in range(len(states)):
            mujoco.mj_resetData(model, data)
            data.qvel[:] = rng_of_states.normal(0.0, 0.1, model.nv)
            data.ctrl[:] = self.controls[i, -1]
            for _ in range(rng_of_states.integers(1, _MOST_STEPS)):
                mujoco.mj_step(model, data)
            # All contenders begin from numbers that float32 has.
            self.warmstarts[i] = data.qacc_warmstart
            mujoco.mj_getState(model, data, states[i], kind)
        self.states = states.astype(np.float32).astype(np.float64)
        """Distinct states, in the layout of `mujoco.rollout`."""

    def first(self, step: FusedMjx) -> MjxState:
        """Return the states for MJX, with a leading axis of instances."""
        data = mujoco.MjData(self.model)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        fields: dict[str, list[np.ndarray]] = {"qpos": [], "qvel": [], "act": [], "time": []}
        for state in self.states:
            mujoco.mj_setState(self.model, data, state, kind)
            for name, values in fields.items():
                values.append(np.array(getattr(data, name), np.float32))
        distinct = {name: np.stack(values) for name, values in fields.items()}
        distinct["qacc_warmstart"] = self.warmstarts
        which = np.arange(self.settings.num_envs) % len(self.states)
        arrays = {name: jnp.asarray(values[which]) for name, values in distinct.items()}
        made = jax.vmap(lambda _: step.init())(which)
        return made.replace(**arrays)


class Round(NamedTuple):
    """A `Round` holds what one round took."""

    env_steps_per_second: float
    """The rate, summed over the instances."""
    cpu_seconds: float
    """Processor time of all threads for one environment step of one instance [s]."""


class Contender(Protocol):
    """A `Contender` steps the instances of a problem in its own way."""

    num_envs: int
    compile_seconds: float | None

    def repeat(self) -> Round:
        """Time one round."""
        ...


class Compiled:
    """A step of one instance that JAX compiles, for all instances of a problem."""

    def __init__(self, problem: Problem, states: Any, step: Callable[[Any, Array], Any]) -> None:
        """Compile a call and warm it up.

        Args:
          problem: the model, states and controls.
          states: a pytree with `qpos` and `qvel`, with a leading axis of instances.
          step: a function of (state, ctrl) of one instance that makes an environment step.
        """
        settings = problem.settings
        self.num_envs, self._unroll = settings.num_envs, settings.unroll
        self._distinct = len(problem.states)

        def call(states: Any, controls: Float[Array, "t n nu"]) -> Any:
            return jax.lax.scan(lambda x, u: (jax.vmap(step)(x, u), None), states, controls)[0]

        start = time.perf_counter()
        self._states, self._call = states, jax.jit(call)
        self._controls = jnp.asarray(problem.controls.swapaxes(0, 1))
        self._program = self._call.lower(self._states, self._controls).compile()
        self.compile_seconds: float | None = time.perf_counter() - start
        self._calls = warm_up(self._time_calls)

    def repeat(self) -> Round:
        """Time one round."""
        return _round(self._time_calls, self._calls, self.num_envs * self._unroll)

    def moved(self) -> Moved:
        """Return the first distinct instances after one environment step."""
        state = self._call(self._states, self._controls[:1])
        return np.array(state.qpos[: self._distinct]), np.array(state.qvel[: self._distinct])

    def _time_calls(self, calls: int) -> float:
        start = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(self._program(self._states, self._controls))
        return time.perf_counter() - start


def _round(time_calls: Callable[[int], float], calls: int, env_steps: int) -> Round:
    """Time some calls, each of which makes so many environment steps of an instance."""
    before = time.process_time()
    seconds = time_calls(calls)
    cpu_seconds = time.process_time() - before
    return Round(env_steps * calls / seconds, cpu_seconds / (env_steps * calls))


def _by_kernel(problem: Problem, step: FusedMjx) -> Compiled:
    return Compiled(problem, problem.first(step), step)


def _by_xla(problem: Problem) -> Compiled:
    """Return `mjx.step`, which XLA compiles."""
    step = fuse_mjx(problem.model, problem.settings.n_substeps)

    def substep(state: MjxState, ctrl: Array) -> MjxState:
        with jax.default_matmul_precision("highest"):
            return step.from_data(mjx.step(step.model, step.to_data(state, ctrl)))

    return Compiled(problem, problem.first(step), _repeated(problem, substep))


def _by_warp(problem: Problem) -> Compiled:
    """Return `mjx.step` with the kernels of MuJoCo Warp."""
    # Its messages about loaded kernels are disabled, and those of each instance whose solver used
    # all iterations.
    warp = importlib.import_module("warp")
    warp.config.log_level = warp.LOG_WARNING
    first = problem.first(fuse_mjx(problem.model))
    model = mjx.put_model(problem.model, impl="warp")
    model = model.tree_replace({"opt._impl.warn_overflow": 0})
    # As many contacts and constraints as MJX makes of this model.
    rows = mjx.make_data(problem.model, impl="jax")._impl
    contacts, constraints = rows.contact.dist.shape[0], rows.efc_J.shape[0]

    def begin(state: MjxState) -> mjx.Data:
        data = mjx.make_data(
            problem.model,
            impl="warp",
            naconmax=max(1, contacts) * problem.settings.num_envs,
            njmax=max(1, constraints),
        )
        names = "qpos", "qvel", "act", "time", "qacc_warmstart"
        return data.replace(**{name: getattr(state, name) for name in names})

    def substep(data: mjx.Data, ctrl: Array) -> mjx.Data:
        return mjx.step(model, data.replace(ctrl=ctrl))

    return Compiled(problem, jax.jit(jax.vmap(begin))(first), _repeated(problem, substep))


def _repeated(
    problem: Problem, substep: Callable[[Any, Array], Any]
) -> Callable[[Any, Array], Any]:
    """Return an environment step of physics steps."""
    count = problem.settings.n_substeps
    return lambda state, ctrl: jax.lax.fori_loop(
        0, count, lambda _, state: substep(state, ctrl), state
    )


class InOtherProcess:
    """MJX, in a process that can be ended while it compiles."""

    def __init__(self, name: str, settings: Settings, limit: float) -> None:
        """Start the process and wait until it has compiled.

        Args:
          name: `mjx` or `warp`.
          settings: the problem.
          limit: the longest time to compile [s].

        Raises:
          TimeoutError: it takes longer.
          UserError: the process failed.
        """
        self.num_envs = min(settings.num_envs, _MOST_IN_MEMORY[name])
        settings = settings._replace(num_envs=self.num_envs)
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, name, settings), daemon=True)
        self._process.start()
        other.close()
        try:
            # Loading the model and moving the instances take a while too: count from their end.
            self._receive()
            if not self._connection.poll(limit):
                raise TimeoutError(f"it compiles for more than {limit:g} s")
            self.compile_seconds = self._receive()
        except BaseException:
            self.close()
            raise

    def repeat(self) -> Round:
        """Time one round."""
        return self._ask("repeat")

    def moved(self) -> Moved:
        """Return the first distinct instances after one environment step."""
        return self._ask("moved")

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()

    def _ask(self, what: str):  # noqa: ANN202
        self._connection.send(what)
        return self._receive()

    def _receive(self):  # noqa: ANN202
        try:
            return self._connection.recv()
        except EOFError:
            raise UserError("the process that steps MJX failed") from None


def _serve(connection: Connection, name: str, settings: Settings) -> None:
    """Compile MJX, and answer for it until the other side closes the connection."""
    problem = Problem(settings)
    connection.send("ready")
    contender = {"mjx": _by_xla, "warp": _by_warp}[name](problem)
    connection.send(contender.compile_seconds)
    while True:
        try:
            what = connection.recv()
        except EOFError:
            return
        connection.send(getattr(contender, what)())


class Mujoco:
    """C MuJoCo on a pool of threads, one for each core."""

    def __init__(self, problem: Problem, *, is_batch: bool) -> None:
        """Start the threads and warm up.

        Args:
          problem: the model, states and controls.
          is_batch: whether `mujoco.batch` steps; otherwise `mujoco.rollout`.
        """
        settings = problem.settings
        threads = available_cores()
        self.num_envs = min(settings.num_envs, threads * _ROBOTS_PER_CORE)
        self.compile_seconds: float | None = None
        self._n_substeps, self._unroll = settings.n_substeps, settings.unroll
        which = np.arange(self.num_envs) % len(problem.states)
        self._states, self._warmstarts = problem.states[which], problem.warmstarts[which]
        # Each control is held for the physics steps of an environment step.
        controls = problem.controls[: self.num_envs].astype(np.float64)
        self._controls = np.repeat(controls, self._n_substeps, axis=1)
        self._roll = self._batch(problem) if is_batch else self._rollout(problem)
        self._calls = warm_up(self._time_calls)

    def repeat(self) -> Round:
        """Time one round."""
        return _round(self._time_calls, self._calls, self.num_envs * self._unroll)

    def _rollout(self, problem: Problem) -> Callable[[], object]:
        """Return a call of `mujoco.rollout`."""
        pool = mujoco.rollout.Rollout(nthread=available_cores())
        data = [mujoco.MjData(problem.model) for _ in range(available_cores())]
        arguments = problem.model, data, self._states, self._controls
        return lambda: pool.rollout(*arguments, initial_warmstart=self._warmstarts)

    def _batch(self, problem: Problem) -> Callable[[], object]:
        """Return a call of `mujoco.batch`."""
        from mujoco.batch import Batch

        batch = Batch(problem.model, self.num_envs, available_cores())
        for state, warmstart, row in zip(self._states, self._warmstarts, batch.state, strict=True):
            data = mujoco.MjData(problem.model)
            mujoco.mj_setState(problem.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
            data.qacc_warmstart[:] = warmstart
            kind = mujoco.mjtState.mjSTATE_INTEGRATION
            mujoco.mj_getState(problem.model, data, row, kind)
        first = batch.state.copy()

        def roll() -> object:
            batch.state[:] = first
            return batch.rollout(self._controls.shape[1], self._controls)

        return roll

    def _time_calls(self, calls: int) -> float:
        start = time.perf_counter()
        for _ in range(calls):
            self._roll()
        return time.perf_counter() - start


def converged(problem: Problem) -> Moved:
    """Return the distinct instances after one step of C MuJoCo whose solver has converged."""
    model = copy.copy(problem.model)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 1000, 100, 1e-12
    controls = problem.controls[: len(problem.states), 0].astype(np.float64)
    qpos, qvel = np.zeros((len(controls), model.nq)), np.zeros((len(controls), model.nv))
    for i, ctrl in enumerate(controls):
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, problem.states[i], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        data.ctrl[:], data.qacc_warmstart[:] = ctrl, problem.warmstarts[i]
        for _ in range(problem.settings.n_substeps):
            mujoco.mj_step(model, data)
        qpos[i], qvel[i] = data.qpos, data.qvel
    return qpos, qvel


def load_model(name: str) -> mujoco.MjModel:
    """Return a model by its name, as in `Settings`.

    Raises:
      UserError: there is no such model.
    """
    kind, _, links = name.partition(":")
    if kind == "chain" and links.isdigit() and int(links):
        return mujoco.MjModel.from_xml_string(_chain(int(links)))
    path = Path(name)
    if name in PACKAGES:
        package, _, inside = PACKAGES[name].partition("/")
        found = importlib.util.find_spec(package)
        if found is None or found.origin is None:
            raise UserError(f"{name} is a model of {package}, which is not installed")
        path = Path(found.origin).parent / inside
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise UserError(f"{name}: {' '.join(str(error).split())}") from None


def _chain(links: int) -> str:
    """Return the MJCF of a hanging chain of hinges without motors."""
    bodies = "".join(
        f'<body pos="0 0 {-0.1 if i else 0}"><joint axis="{i % 2} {1 - i % 2} 0" damping="0.01"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.05"/>'
        for i in range(links)
    )
    return (
        '<mujoco><option timestep="0.002"/><default><geom contype="0" conaffinity="0"/></default>'
        f"<worldbody>{bodies}{'</body>' * links}</worldbody></mujoco>"
    )


def difference(one: Moved, other: Moved) -> float:
    """Return the largest difference of positions or velocities, relative to the largest number."""
    count = min(len(one[0]), len(other[0]))
    return max(
        float(np.abs(a[:count].astype(np.float64) - b[:count]).max() / max(np.abs(b).max(), 1e-12))
        for a, b in zip(one, other, strict=True)
    )


def measure(settings: Settings, rounds: int, xla_limit: float) -> Iterator[Row]:
    """Measure all contenders with one model.

    Args:
      settings: the problem.
      rounds: number of rounds, in each of which every contender is timed once.
      xla_limit: the longest time to compile MJX [s]; 0: leave it out, and MJX-Warp too.

    Yields:
      One row for each contender.
    """
    problem = Problem(settings)
    notes: dict[str, str] = dict.fromkeys(("kernel", "mjx", "warp", "rollout", "batch"), "")
    contenders: dict[str, Contender] = {
        "rollout": Mujoco(problem, is_batch=False),
        "batch": Mujoco(problem, is_batch=True),
    }
    with contextlib.ExitStack() as stack:
        compiled: dict[str, Compiled | InOtherProcess] = {}
        try:
            step = fuse_mjx(problem.model, settings.n_substeps, on_unsupported="xla")
            notes |= {"kernel": step.obstacle or "", "warp": _no_warp()}
            if not xla_limit:
                notes |= {"mjx": "left out", "warp": "left out"}
            if not notes["kernel"]:
                compiled["kernel"] = _by_kernel(problem, step)
        except UnsupportedError as error:
            notes |= dict.fromkeys(("kernel", "mjx", "warp"), str(error))
        for name in [name for name in ("mjx", "warp") if not notes[name]]:
            try:
                compiled[name] = other = InOtherProcess(name, settings, xla_limit)
                stack.callback(other.close)
            except TimeoutError as error:
                notes[name] = str(error)
        contenders |= compiled
        repeats: dict[str, list[Round]] = {name: [] for name in contenders}
        for _ in range(rounds):
            for name, contender in contenders.items():
                repeats[name].append(contender.repeat())
        moved = {name: contender.moved() for name, contender in compiled.items()}
    reference = converged(problem)
    for name in notes:
        from_mujoco = difference(moved[name], reference) if name in moved else None
        both = name == "kernel" and {"kernel", "mjx"} <= moved.keys()
        from_mjx = difference(moved["kernel"], moved["mjx"]) if both else None
        contender, timed = contenders.get(name), repeats.get(name, [])
        differences = from_mujoco, from_mjx
        yield _row(problem, name, contender, timed, differences, notes[name])


def _row(
    problem: Problem,
    name: str,
    contender: Contender | None,
    timed: Sequence[Round],
    differences: tuple[float | None, float | None],
    note: str,
) -> Row:
    """Return the row of a contender; None: it cannot make a step here."""
    rates = [x.env_steps_per_second for x in timed]
    is_on_cpu = name in ("rollout", "batch") or jax.default_backend() == "cpu"
    return Row(
        problem.settings.name,
        problem.model.nv,
        name,
        problem.settings.num_envs if contender is None else contender.num_envs,
        statistics.median(rates) if rates else None,
        statistics.median(x.cpu_seconds for x in timed) if timed and is_on_cpu else None,
        None if contender is None else contender.compile_seconds,
        rates,
        *differences,
        note,
    )


def _no_warp() -> str:
    """Return why MJX-Warp cannot run here; empty if it can."""
    if jax.default_backend() != "gpu":
        return "it needs an NVIDIA GPU"
    return "" if importlib.util.find_spec("warp") else "warp-lang is not installed"


_HEAD = (
    f"{'model':26}{'nv':>4} {'contender':10}{'num_envs':>9}{'env steps/s':>13}"
    f"{'min .. max':>19}{'cpu/step':>13}{'compile':>10}{'from mujoco':>13}{'from mjx':>10}"
)


def table_line(row: Row) -> str:
    """Return a row of the printed table."""

    def text(x: float | None, form: str) -> str:
        return "" if x is None else format(x, form)

    rate, spread, cpu = "-", "", ""
    if row.cpu_seconds is not None:
        cpu = f"{1e6 * row.cpu_seconds:.4g} µs"
    if row.env_steps_per_second is not None:
        rate = format_count(row.env_steps_per_second, 4)
        spread = format_spread(row.env_steps_per_second, row.repeats)
    seconds = "" if row.compile_seconds is None else f"{row.compile_seconds:.1f} s"
    return (
        f"{row.model:26}{row.nv:4} {row.contender:10}{row.num_envs:9,}{rate:>13}{spread:>19}"
        f"{cpu:>13}{seconds:>10}{text(row.from_mujoco, '.0e'):>13}{text(row.from_mjx, '.0e'):>10}"
        f"{'  ' + row.note if row.note else ''}"
    )


def plot_rates(rows: Sequence[Mapping[str, Any]], title: str) -> Figure:
    """Plot the rates of all contenders, a line for each model.

    Args:
      rows: rows as `Row._asdict` returns them.
      title: the device and the settings.

    Returns:
      The figure, in the colours of the active theme.
    """
    models = list(dict.fromkeys(row["model"] for row in rows))
    figure = Figure(figsize=(7.2, 1.3 + 0.36 * len(models)), layout="constrained")
    axes = figure.subplots()
    for index, contender in enumerate(dict.fromkeys(row["contender"] for row in rows)):
        points = [
            (row["env_steps_per_second"], models.index(row["model"]))
            for row in rows
            if row["contender"] == contender and row["env_steps_per_second"]
        ]
        if points:
            style: Any = {"color": f"C{index}", "marker": "osD^v"[index % 5], "ls": ""}
            axes.plot(*zip(*points, strict=True), label=contender, markersize=6, **style)
    axes.set(xscale="log", xlabel="environment steps per second", title=title)
    axes.title.set_fontsize(9)
    axes.set_yticks(range(len(models)), models)
    axes.set_ylim(len(models) - 0.5, -0.5)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: format_count(value)))
    axes.grid()
    axes.set_axisbelow(True)
    figure.legend(loc="outside lower center", ncols=5, fontsize="small")
    return figure


def _parser() -> cli.Parser:
    """Return the parser of the command line."""
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "models",
        nargs="*",
        default=list(GYMNASIUM),
        metavar="MODEL",
        help=f"chain:LINKS, MJCF files, or of {', '.join(PACKAGES)} (default: the first eight)",
    )
    positive = cli.positive_int
    parser.add_argument("--num-envs", type=positive, help="instances (default: 65,536, CPU: 1,024)")
    parser.add_argument("--integrator", choices=("own", *INTEGRATORS), default="own")
    parser.add_argument("--solver", choices=("own", *SOLVERS), default="own")
    parser.add_argument("--iterations", type=positive, help="most iterations of the solver")
    parser.add_argument("--ls-iterations", type=positive, help="most of each line search")
    parser.add_argument("--tolerance", type=float, help="improvement at which the solver stops")
    parser.add_argument("--n-substeps", type=positive, default=2, help="physics steps in a step")
    parser.add_argument("--unroll", type=positive, default=32, help="environment steps in a call")
    parser.add_argument("--rounds", type=positive, default=5)
    parser.add_argument(
        "--xla-limit",
        type=float,
        default=60.0,
        metavar="SECONDS",
        help="the longest time to compile MJX, by XLA or for Warp; 0: leave both out (default: 60)",
    )
    parser.add_argument(
        "--output", type=Path, help="a JSON file for the results; a plot is written beside it"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, measure, print a table and write a file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.
    """
    options = _parser().parse_args(arguments)
    if not 0 <= options.xla_limit < math.inf:
        raise UserError(f"--xla-limit {options.xla_limit}: name a number of seconds, or 0")
    solver = {name: getattr(options, name) for name in ("iterations", "ls_iterations", "tolerance")}
    solver = {name: value for name, value in solver.items() if value is not None}
    if options.solver != "own":
        solver["solver"] = int(SOLVERS[options.solver])
    if not 0 <= solver.get("tolerance", 0) < 1:
        raise UserError(f"--tolerance {options.tolerance}: name a number from 0 to 1, such as 1e-6")
    if options.output:
        check_output(options.output)
    # Two processes share the device.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    device = jax.devices()[0]
    num_envs = options.num_envs or (65_536 if device.platform == "gpu" else 1024)
    print(f"{device.device_kind}, {available_cores()} cores")
    print(_HEAD)
    rows = []
    for name in options.models:
        numbers = num_envs, options.n_substeps, options.unroll
        settings = Settings(name, options.integrator, tuple(solver.items()), *numbers)
        for row in measure(settings, options.rounds, options.xla_limit):
            rows.append(row._asdict())
            print(table_line(row), flush=True)
    if options.output:
        about = {
            "device": device.device_kind,
            "cpu_cores": available_cores(),
            "versions": versions(),
            "integrator": options.integrator,
            "solver": solver,
            "n_substeps": options.n_substeps,
            "unroll": options.unroll,
        }
        write(options.output, {**about, "rows": rows})
        title = f"{device.device_kind}, {available_cores()} cores, {num_envs:,} instances"
        image = options.output.with_suffix(".png")
        with theme("light"):
            write_bytes(image, to_png(plot_rates(rows, title)))
        print(f"wrote {options.output} and {image}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
