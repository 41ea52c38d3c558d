"""Train with `ppo.PPO`, compiled once for all devices and all seeds, so that it can be resumed.

Motivation: a training must answer signals and show progress while the devices work, and a training
that was stopped anywhere must continue with bit-identical results.

Protocol:
  Chunked calls. The compiled program `advance(state, steps, restart)` runs `steps` training steps
    in one call. The number is an argument, so that one program serves calls of any length;
    `next_chunk` chooses it such that a call takes about one second. Between two calls the loop
    checks for signals and reports progress. The metrics are summed inside the state, so neither the
    results nor the logged metrics depend on how the steps were divided into calls.
  Exact resume. `TrainState` holds everything that the next step depends on. At the end of every
    interval the callback receives it with its sums set to zero, as the next call would begin; where
    a signal stops the training between two reports, `on_preempt` receives it with the sums so far.
  Several processes. Each device holds its share of every seed's environments and a copy of all
    other arrays. All processes run this module, call for call: before every call they gather
    whether one of them was asked to stop, and all take the number of steps from the first process.
    Only the first process invokes the callback for reports; the others receive what it returned.
"""

import contextlib
import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Self

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, UInt32

from jetbot_mjx.agents import LOSSES, PPO, DeviceAxis, NanDump, TrainState
from jetbot_mjx.runs import Setup
from jetbot_mjx.training import distributed
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.preemption import StopRequest
from onekernel import ProgramCache
from onekernel.build import in_background

_AXIS = "devices"
_MAX_CALL_SECONDS = 1.0
_CALLS_PER_NOTICE = 10
_POLL_SECONDS = 0.02

Advance = Callable[[TrainState, int, bool], tuple[TrainState, NanDump]]
"""The compiled training step: (state, training steps, whether to restart the sums)."""


def build_ppo(setup: Setup) -> PPO:
    """Build PPO over all devices.

    Args:
      setup: environment and networks, of a configuration that has passed `check_devices`.
    """
    devices = DeviceAxis(jax.device_count(), _AXIS)
    return PPO(setup.config.ppo, setup.training_env, setup.networks, devices)


class CompiledTrainer:
    """A `CompiledTrainer` runs PPO as compiled programs, over all devices and all seeds."""

    def __init__(self, ppo: PPO, seeds: Sequence[int], programs: ProgramCache) -> None:
        """Prepare the programs, which compile at their first use.

        Args:
          ppo: PPO over all devices, from `build_ppo`.
          seeds: the random seed of each policy that is trained.
          programs: the cache of compiled programs of this configuration.
        """
        self.ppo = ppo
        # Keep the seeds on the host, from where the devices of every process can read them.
        self._seeds = np.array(seeds, np.uint32)
        self._programs = programs
        # Take the shapes from the cached program where there is one, because tracing takes longer.
        self._compiled_init = programs.find("init")
        self._shapes = (
            jax.eval_shape(self._init, self._seeds)
            if self._compiled_init is None
            else jax.tree.map(
                lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), self._compiled_init.out_info
            )
        )
        # Shard the environments, which are the second axis after the seeds; replicate the rest.
        self._mesh = Mesh(np.array(jax.devices()), (_AXIS,))
        replicated = jax.tree.map(lambda _: PartitionSpec(), self._shapes)
        sharded = jax.tree.map(lambda _: PartitionSpec(None, _AXIS), self._shapes.env_state)
        self._specs = replicated.replace(env_state=sharded)
        self._shardings = jax.tree.map(lambda spec: NamedSharding(self._mesh, spec), self._specs)
        self._replicated = NamedSharding(self._mesh, PartitionSpec())

    @classmethod
    def from_setup(cls, setup: Setup) -> Self:
        """Build the trainer of a setup; nothing is compiled yet."""
        seeds = [one.seed for one in setup.config.of_each_seed()]
        return cls(build_ppo(setup), seeds, setup.programs)

    def template(self) -> TrainState:
        """Return the shapes and dtypes of one seed's state."""
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), self._shapes)
        return jax.eval_shape(self.ppo.unpacked, one)

    def init(self) -> TrainState:
        """Return the packed state before the first step, on the devices."""
        return self.init_later()()

    def init_later(self) -> Callable[[], TrainState]:
        """Begin to compile the program of `init`, and return a function that does the rest."""
        found = self._compiled_init
        if found is not None:
            return lambda: found(self._seeds)
        jitted = jax.jit(self._init, in_shardings=self._replicated, out_shardings=self._shardings)
        program = self._programs.compile_later(
            "init", lambda: jitted.trace(self._seeds), inside=_random_bits_by_kernel()
        )
        return lambda: program()(self._seeds)

    def _init(self, seeds: UInt32[Array, " seeds"]) -> TrainState:
        def init(seed: UInt32[Array, ""]) -> TrainState:
            return self.ppo.packed(self.ppo.init(jax.random.PRNGKey(seed)))

        return jax.vmap(init)(seeds)

    def put(self, states: Sequence[TrainState]) -> TrainState:
        """Copy the states of all seeds from the host to the devices.

        Args:
          states: the state of each seed, as arrays on the host.

        Returns:
          One state with the seeds as the first axis.
        """
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *map(self.ppo.packed, states))
        return jax.tree.map(
            lambda x, sharding: jax.make_array_from_callback(x.shape, sharding, x.__getitem__),
            stacked,
            self._shardings,
        )

    def get(self, state: TrainState) -> list[TrainState]:
        """Copy the state from the devices to the host, and return that of each seed."""
        if jax.process_count() > 1:
            # A process cannot read the devices of another: replicate everything first.
            state = jax.jit(lambda state: state, out_shardings=self._replicated)(state)
        leaves, structure = jax.tree.flatten(state)
        # As leaves, because Brax's counters are JAX arrays even on the host: to index one compiles.
        host = jax.device_get(leaves)
        each = [structure.unflatten([x[i] for x in host]) for i in range(len(self._seeds))]
        return [self.ppo.unpacked(state) for state in each]

    def compile(self) -> Advance:
        """Compile the training step once; another shape is an error and never compiles again.

        Returns:
          A function of (state, training steps, whether to restart the sums). It donates the memory
          of the state to its result. The dumps that it returns have the axes (devices, seeds).
        """
        program = self._programs.compile("advance", self.trace, self._check, tune=True)

        def call(state: TrainState, steps: int, restart: bool) -> tuple[TrainState, NanDump]:
            return program(state, np.int32(steps), np.bool_(restart))

        return call

    @functools.cached_property
    def _launchable(self) -> PPO:
        # Not before a program is traced: the back end's check takes a while.
        return self.ppo.launchable()

    def trace(self) -> jax.stages.Traced:
        """Trace the training step for all devices, without compiling it."""
        # Check the back end first: LLVM does one thing at a time, and physics waits for this.
        ppo = self._launchable
        ppo.learner.prepare(len(self._seeds))
        return self._trace(ppo)

    def _check(self) -> Callable[[], jax.stages.Traced] | None:
        """Return None if the kernels passed their check, or a function that traces XLA's update."""
        failure = self._launchable.learner.failure()
        return None if failure is None else lambda: self._trace(self._launchable.with_xla(failure))

    def _trace(self, ppo: PPO) -> jax.stages.Traced:
        """Trace the training step of `ppo` for all devices."""
        # CPUs multiply the matrices of a batch faster.
        alone = len(self._seeds) == 1 and jax.default_backend() == "gpu"

        def advance(
            state: TrainState, steps: jax.Array, restart: jax.Array
        ) -> tuple[TrainState, NanDump]:
            if alone:
                # A batch of one would be traced a second time, as a batch.
                one = jax.tree.map(lambda x: x[0], state)
                result = ppo.advance(one, steps, restart)
                state, nan_dump = jax.tree.map(lambda x: x[None], result)
            else:
                state, nan_dump = jax.vmap(ppo.advance, in_axes=(0, None, None))(
                    state, steps, restart
                )
            return state, jax.tree.map(lambda x: x[None], nan_dump)

        sharded = jax.shard_map(
            advance,
            mesh=self._mesh,
            in_specs=(self._specs, PartitionSpec(), PartitionSpec()),
            out_specs=(self._specs, PartitionSpec(_AXIS)),
            # Brax's functions average the gradients over devices themselves, as under `pmap`.
            check_vma=False,
        )
        jitted = jax.jit(
            sharded,
            donate_argnums=0,
            in_shardings=(self._shardings, self._replicated, self._replicated),
            # Every process receives the dumps of all devices.
            out_shardings=(self._shardings, self._replicated),
        )
        scalars = (np.zeros((), np.int32), np.zeros((), bool))
        return jitted.trace(self._shapes, *scalars)


@contextlib.contextmanager
def _random_bits_by_kernel() -> Iterator[None]:
    """Lower draws of random bits on GPUs to JAX's kernel inside the context, with the same result.

    As JAX does it by default, a draw is a hundred operations, which XLA fuses with those around
    them. That is faster, but a program that runs once takes a second longer to compile. Caches of
    programs lower no other program meanwhile.
    """
    option = "jax_threefry_gpu_kernel_lowering"
    before = jax.config.values.get(option)
    if before is None or jax.default_backend() != "gpu":
        # This JAX does not have the option, or there is no GPU.
        yield
        return
    jax.config.update(option, True)
    try:
        yield
    finally:
        jax.config.update(option, before)


def train(
    trainer: CompiledTrainer,
    recorder: TrainerCallback,
    stop: StopRequest,
    checkpoint_interval: int,
    states: Sequence[TrainState] | None = None,
    *,
    resumes: bool = False,
) -> None:
    """Train until the end, until the callback asks to stop, or until a signal arrives.

    Args:
      trainer: the compiled trainer of the run.
      recorder: the callback that receives every report.
      stop: the request to stop, which is checked while compiling and before every call.
      checkpoint_interval: environment steps from one report to the next, at least.
      states: the state of each seed to start from, on the host; None: that of its seed.
      resumes: whether these states were reported before.
    """
    # Trace one program while XLA compiles the one before: that of the first state, that of the
    # training steps, and, in the report, that of the evaluation.
    init = trainer.init_later() if states is None else lambda: trainer.put(states)
    compiling = in_background(trainer.compile)
    state = init()
    done = env_steps(states[0]) // trainer.ppo.config.steps_per_training_step if states else 0
    if not resumes and not _report(trainer, recorder, state, 0.0):
        return
    # Wait until every process has compiled; leave if one of them was asked to stop.
    running = True
    while running:
        stopped = stop.wait(_POLL_SECONDS)
        gathered = distributed.all_gather_ints(stopped, not compiling.done())
        if gathered[:, 0].any():
            return
        running = gathered[:, 1].any()
    advance = compiling.result()
    stop.compiling = None
    recorder.on_compiled()
    _train_loop(trainer, advance, recorder, stop, checkpoint_interval, state, done)


def _train_loop(
    trainer: CompiledTrainer,
    advance: Advance,
    recorder: TrainerCallback,
    stop: StopRequest,
    checkpoint_interval: int,
    state: TrainState,
    done: int,
) -> None:
    """Run the training steps from number `done` on, call by call; see the module's protocol."""
    config = trainer.ppo.config
    size = config.steps_per_training_step
    interval = -(-checkpoint_interval // size)
    call_seconds = min(_MAX_CALL_SECONDS, stop.notice / _CALLS_PER_NOTICE)
    chunk, seconds, restart = 1, 0.0, False
    while done < config.training_steps:
        # Agree with the other processes on whether to go on, and on the length of the call.
        goal = min(config.training_steps, (done // interval + 1) * interval)
        gathered = distributed.all_gather_ints(stop.requested, min(chunk, goal - done))
        if gathered[:, 0].any():
            break
        count = int(gathered[0, 1])
        # Run the steps; reading a result waits until the devices have finished.
        began = time.perf_counter()
        state, nan_dumps = advance(state, count, restart)
        found = np.asarray(nan_dumps.found)
        elapsed = time.perf_counter() - began
        chunk = next_chunk(count, elapsed, call_seconds)
        done, seconds, restart = done + count, seconds + elapsed, False
        # Of several devices the first that has a dump: it is stored under the steps alone.
        for seed in np.flatnonzero(found.any(axis=0)):
            at = found[:, seed].argmax(), seed
            packed = jax.tree.map(lambda x, at=at: np.asarray(x)[at], nan_dumps)
            nan_dump = packed.replace(env_state=packed.env_state.unpack())
            recorder.on_nan_dump(int(seed), done * size, nan_dump)
        # Show the progress within an interval, and report at its end.
        if done < goal:
            mean = state.replace(tally=np.mean(jax.device_get(state.tally), axis=0))
            recorder.on_progress(done * size, _metrics(mean.sums, trainer.ppo), seconds)
            continue
        if not _report(trainer, recorder, state, seconds):
            return
        seconds, restart = 0.0, True
    # Save what was trained since the last report.
    if seconds > 0:
        progress = _progress(trainer, state, seconds, restart=False)
        distributed.run_on_primary(lambda: recorder.on_preempt(progress))


def _report(
    trainer: CompiledTrainer, recorder: TrainerCallback, state: TrainState, seconds: float
) -> bool:
    """Report the end of an interval; a training that resumes from here restarts the sums.

    Returns:
      Whether to go on, in all processes.
    """
    progress = _progress(trainer, state, seconds, restart=True)
    return bool(distributed.run_on_primary(lambda: recorder.on_interval(progress)))


def _progress(
    trainer: CompiledTrainer, state: TrainState, seconds: float, *, restart: bool
) -> list[Progress]:
    """Return the progress of every seed, on the host.

    Args:
      trainer: the compiled trainer of the run.
      state: the state on the devices.
      seconds: training time since the last report [s].
      restart: whether the state that is returned begins new sums.
    """
    progress = []
    for one in trainer.get(state):
        metrics = _metrics(one.sums, trainer.ppo)
        saved = one.replace(tally=np.zeros_like(one.tally)) if restart else one
        progress.append(Progress(env_steps(one), one.policy_params, metrics, seconds, saved))
    return progress


def next_chunk(steps: int, seconds: float, wanted: float) -> int:
    """Return how many training steps the next call runs.

    Args:
      steps: the steps of the last call.
      seconds: the duration of the last call [s].
      wanted: the desired duration of a call [s].
    """
    return max(1, int(steps * wanted / max(seconds, 1e-6)))


def env_steps(state: TrainState) -> int:
    """Return the environment steps of a state on the host."""
    return int(state.env_steps.to_numpy())


def _metrics(totals: Mapping[str, Array], ppo: PPO) -> dict[str, float]:
    """Return means and counts from the sums of a state; empty before the first step."""
    sums = {name: float(value) for name, value in totals.items()}
    steps, episodes = sums["training_steps"], sums["rollout/episodes"]
    if steps == 0:
        return {}
    metrics = {}
    applied = steps * ppo.config.updates_per_training_step - sums["nonfinite_updates"]
    if applied > 0:
        metrics |= {name: sums[name] / applied for name in LOSSES.values()}
        if ppo.config.entropy_cost > 0:
            metrics["policy/entropy"] = -metrics["loss/entropy"] / ppo.config.entropy_cost
    metrics["rollout/episodes"] = episodes
    if episodes > 0:
        if ppo.has_success:
            metrics["rollout/success_rate"] = sums["rollout/successes"] / episodes
        metrics["rollout/episode_return"] = sums["rollout/return"] / episodes
        metrics["rollout/episode_length"] = sums["rollout/length"] / episodes
    metrics["train/nonfinite_envs"] = sums["nonfinite_envs"]
    metrics["train/nonfinite_updates"] = sums["nonfinite_updates"]
    return metrics
