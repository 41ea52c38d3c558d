"""The resumable trainer: `ppo.PPO` compiled once, over all devices and all seeds.

Each device holds its share of every seed's environments and a copy of the rest; the devices may
be those of several processes, which then all run this, call for call. How many
training steps one call makes is an argument of the compiled program: short calls answer
signals and tell of progress, and since metrics are summed inside the state, what is logged and
what is computed do not depend on how the steps were cut into calls.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, UInt32

from jetbot_mjx.agents.ppo import LOSSES, PPO, NanDump, TrainState
from jetbot_mjx.compiler.program_cache import ProgramCache
from jetbot_mjx.config import Config
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.program_key import open_program_cache
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.training import distributed
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.preemption import Preemption

_AXIS = "devices"
_CALL_SECONDS = 1.0
_CALLS_PER_NOTICE = 10


class CompiledTrainer:
    """One configuration's training, over all devices and all its seeds."""

    def __init__(
        self, config: Config, env: JetBotEnv, programs: ProgramCache | None = None
    ) -> None:
        """Prepare the program; nothing is compiled yet.

        Args:
          config: the run; `check_devices` has passed it.
          env: the environment, unwrapped.
          programs: of that configuration; None: they are not kept.
        """
        self._programs = programs or open_program_cache(config, keep=False)
        devices = jax.devices()
        self._mesh = Mesh(np.array(devices), (_AXIS,))
        # On the host, from where every process's devices can take them.
        self._seeds = np.arange(config.seed, config.seed + config.seeds, dtype=np.uint32)
        self._ppo = PPO(
            config.ppo,
            wrap_for_training(env, config.task.episode_length),
            axis_name=_AXIS,
            device_count=len(devices),
        )
        self._compiled_init = self._programs.find("init")
        self._shapes = (
            jax.eval_shape(self._init, self._seeds)
            if self._compiled_init is None
            else jax.tree.map(
                lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), self._compiled_init.out_info
            )
        )
        # Seeds come first, and environments second.
        replicated = jax.tree.map(lambda _: PartitionSpec(), self._shapes)
        shared = jax.tree.map(lambda _: PartitionSpec(None, _AXIS), self._shapes.env_state)
        self._specs = replicated.replace(env_state=shared)
        self._shardings = jax.tree.map(lambda spec: NamedSharding(self._mesh, spec), self._specs)
        self._whole = NamedSharding(self._mesh, PartitionSpec())

    def template(self) -> TrainState:
        """Return shapes and dtypes of one seed's state."""
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), self._shapes)

    def init(self) -> TrainState:
        """Return the state before the first step, on the devices."""
        program = self._compiled_init
        if program is None:
            jitted = jax.jit(self._init, in_shardings=self._whole, out_shardings=self._shardings)
            program = self._programs.compile("init", lambda: jitted.trace(self._seeds))
        return program(self._seeds)

    def _init(self, seeds: UInt32[Array, " seeds"]) -> TrainState:
        return jax.vmap(lambda seed: self._ppo.init(jax.random.PRNGKey(seed)))(seeds)

    def put(self, states: Sequence[TrainState]) -> TrainState:
        """Put states of all seeds from the host onto the devices."""
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *states)
        return jax.tree.map(
            lambda x, sharding: jax.make_array_from_callback(x.shape, sharding, x.__getitem__),
            stacked,
            self._shardings,
        )

    def get(self, state: TrainState) -> list[TrainState]:
        """Return states of all seeds, on the host."""
        if jax.process_count() > 1:
            # What lies on another process's devices cannot be fetched.
            state = jax.jit(_identity, out_shardings=self._whole)(state)
        host = jax.device_get(state)
        return [jax.tree.map(lambda x, i=index: x[i], host) for index in range(len(self._seeds))]

    def compile(self) -> Callable[[TrainState, int, bool], tuple[TrainState, NanDump]]:
        """Compile the training step, for once and for all: another shape is an error, not a wait.

        Returns:
          A function of (state, training steps, whether the tally starts anew), which takes the
          state's memory for its result. Faults have the axes (devices, seeds).
        """
        program = self._programs.compile("advance", self.trace)

        def call(state: TrainState, steps: int, restart: bool) -> tuple[TrainState, NanDump]:
            return program(state, np.int32(steps), np.bool_(restart))

        return call

    def trace(self) -> jax.stages.Traced:
        """Return the training step for the devices, not yet compiled."""

        def advance(state: TrainState, steps: jax.Array, restart: jax.Array) -> Any:
            state, nan_dump = jax.vmap(self._ppo.advance, in_axes=(0, None, None))(
                state, steps, restart
            )
            return state, jax.tree.map(lambda x: x[None], nan_dump)

        sharded = jax.shard_map(
            advance,
            mesh=self._mesh,
            in_specs=(self._specs, PartitionSpec(), PartitionSpec()),
            out_specs=(self._specs, PartitionSpec(_AXIS)),
            # Brax's utilities average gradients themselves, as under `pmap`.
            check_vma=False,
        )
        jitted = jax.jit(
            sharded,
            donate_argnums=0,
            in_shardings=(self._shardings, self._whole, self._whole),
            # Every process sees the nan_dumps of all.
            out_shardings=(self._shardings, self._whole),
        )
        scalars = (np.zeros((), np.int32), np.zeros((), bool))
        return jitted.trace(self._shapes, *scalars)


def train(
    config: Config,
    program: CompiledTrainer,
    recorder: TrainerCallback,
    preemption: Preemption,
    states: Sequence[TrainState] | None = None,
) -> None:
    """Train until the end, until the recorder has enough, or until a signal comes.

    Args:
      config: the run.
      program: of that run.
      recorder: hears of everything.
      preemption: asked before every call and while compiling.
      states: where each seed stands, on the host; None: at the beginning.
    """
    compiling = _Background(program.compile)
    if states is None:
        state = program.init()
        if not _report(config, program, recorder, state, 0.0):
            return
        done = 0
    else:
        state = program.put(states)
        done = env_steps(states[0]) // config.ppo.steps_per_training_step
    running = True
    while running:
        heard = distributed.all_gather_ints(preemption.wait(0.02), compiling.running)
        if heard[:, 0].any():
            return
        running = heard[:, 1].any()
    advance = compiling.result()
    recorder.on_compiled()

    size = config.ppo.steps_per_training_step
    interval = -(-config.checkpoint_interval // size)
    pace = ChunkSizer(min(_CALL_SECONDS, config.preemption_notice / _CALLS_PER_NOTICE))
    seconds, restart = 0.0, False
    while done < config.ppo.training_steps:
        goal = min(config.ppo.training_steps, (done // interval + 1) * interval)
        heard = distributed.all_gather_ints(preemption.requested, min(pace.steps, goal - done))
        if heard[:, 0].any():
            break
        count = int(heard[0, 1])
        began = time.perf_counter()
        state, nan_dumps = advance(state, count, restart)
        found = np.asarray(nan_dumps.found)
        lasted = time.perf_counter() - began
        pace.update(count, lasted)
        done, seconds, restart = done + count, seconds + lasted, False
        for device, seed in np.argwhere(found):
            nan_dump = jax.tree.map(lambda x, at=(device, seed): np.asarray(x)[at], nan_dumps)
            recorder.on_nan_dump(int(seed), done * size, nan_dump)
        if done < goal:
            tallies = jax.device_get(state.tally)
            metrics = _metrics(config, jax.tree.map(np.mean, tallies))
            recorder.on_progress(done * size, metrics, seconds)
            continue
        if not _report(config, program, recorder, state, seconds):
            return
        seconds, restart = 0.0, True
    # After a report there is nothing new to save.
    if seconds > 0:
        _pause(config, program, recorder, state, seconds)


def _report(
    config: Config,
    program: CompiledTrainer,
    recorder: TrainerCallback,
    state: TrainState,
    seconds: float,
) -> bool:
    """At the end of an interval: whoever goes on from here begins a new tally."""
    begins_anew = [
        _progress(config, one, seconds)._replace(
            state=one.replace(tally=jax.tree.map(np.zeros_like, one.tally))
        )
        for one in program.get(state)
    ]
    return bool(distributed.run_on_primary(lambda: recorder.on_interval(begins_anew)))


def _pause(
    config: Config,
    program: CompiledTrainer,
    recorder: TrainerCallback,
    state: TrainState,
    seconds: float,
) -> None:
    progress = [_progress(config, one, seconds) for one in program.get(state)]

    def save() -> int:
        recorder.on_preempt(progress)
        return 0

    distributed.run_on_primary(save)


def _identity(state: TrainState) -> TrainState:
    return state


class ChunkSizer:
    """The number of training steps that a call may make."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.steps = 1

    def update(self, steps: int, seconds: float) -> None:
        """Draw the consequence from the last call."""
        self.steps = max(1, int(steps * self._seconds / max(seconds, 1e-6)))


class _Background:
    """A function's result, computed in a thread of its own."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self._outcome: list[Any] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=[function], daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    def result(self) -> Any:
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._outcome[0]

    def _run(self, function: Callable[[], Any]) -> None:
        try:
            self._outcome.append(function())
        except BaseException as error:  # handed on to who asks for the result
            self._error = error


def env_steps(state: TrainState) -> int:
    """Environment steps of a state on the host."""
    return int(state.env_steps.to_numpy())


def _progress(config: Config, state: TrainState, seconds: float) -> Progress:
    return Progress(
        env_steps(state), state.policy_params, _metrics(config, state.tally), seconds, state
    )


def _metrics(config: Config, tally: Mapping[str, Any]) -> dict[str, float]:
    """Return means and counts from sums; empty before the first step."""
    sums = {name: float(value) for name, value in tally.items()}
    steps, episodes = sums["training_steps"], sums["rollout/episodes"]
    if steps == 0:
        return {}
    metrics = {name: sums[name] / steps for name in LOSSES.values()}
    if config.ppo.entropy_cost > 0:
        metrics["policy/entropy"] = -metrics["loss/entropy"] / config.ppo.entropy_cost
    metrics["rollout/episodes"] = episodes
    if episodes > 0:
        metrics["rollout/success_rate"] = sums["rollout/successes"] / episodes
        metrics["rollout/episode_return"] = sums["rollout/return"] / episodes
        metrics["rollout/episode_length"] = sums["rollout/length"] / episodes
    metrics["train/nonfinite_envs"] = sums["nonfinite_envs"]
    metrics["train/nonfinite_updates"] = sums["nonfinite_updates"]
    return metrics
