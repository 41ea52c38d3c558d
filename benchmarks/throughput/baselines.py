"""Run other simulators and trainers, with which this project's rates are compared.

Each benchmark is compiled and warmed up once, and timed by every call of `repeat`, so that several
can be timed in turn. Optional packages are imported only where they are used.
"""

import importlib
import time
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float
from mujoco import mjx

from benchmarks.harness.measurements import Sizes
from benchmarks.harness.timing import (
    Z_RANGE,
    Carry,
    Row,
    Tally,
    TimedProgram,
    available_cores,
    env_keys,
    make_row,
    random_actions,
    sum_per_env,
    warm_up,
)
from benchmarks.throughput.one_robot import OneRobot, make_physics_model, wheel_targets
from jetbot_mjx.config import Config
from jetbot_mjx.envs.jetbot_env import make_jetbot_env
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.errors import UserError

PLAYGROUND_ENV = "CartpoleBalance"
_PLAYGROUND_EPISODE = 1000

# The tutorial's hyperparameters; the comments in configs/isaac_sb3.yaml name their source.
_SB3_STEPS = 2560
_SB3: dict[str, Any] = {
    "n_steps": _SB3_STEPS,
    "batch_size": 64,
    "n_epochs": 5,
    "gamma": 0.9,
    "gae_lambda": 1.0,
    "learning_rate": 1.25e-4,
    "clip_range": 0.3,
    "ent_coef": 7.5e-8,
    "vf_coef": 0.95,
    "max_grad_norm": 0.9,
}
_SB3_LAYERS = [16, 128, 128, 128]


class Benchmark(Protocol):
    """A `Benchmark` can be timed in turn with others."""

    rate: str
    num_envs: int

    def repeat(self) -> float:
        """Return the environment steps per second of one repeat."""
        ...

    def row(self, repeats: list[float]) -> Row:
        """Return the measured row, given the values that `repeat` returned."""
        ...


class MujocoRollout:
    """C MuJoCo's own thread pool, `mujoco.rollout`, with one thread for each core.

    The controls are drawn before the timing starts. Every state is returned, because the interface
    of `mujoco.rollout` requires it.
    """

    rate = "mujoco"

    def __init__(self, config: Config, num_envs: int, sizes: Sizes) -> None:
        """Start the threads and warm up.

        Args:
          config: The robot and physics.
          num_envs: The number of robots.
          sizes: The number of environment steps in one call.
        """
        # One MjData for each thread, and one state for each robot.
        self.num_envs = num_envs
        self._n_substeps = config.physics.n_substeps
        self._env_steps = sizes.unroll
        self._model = make_physics_model(config)
        threads = available_cores()
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._pool = mujoco.rollout.Rollout(nthread=threads)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        size = mujoco.mj_stateSize(self._model, kind)
        first = np.zeros(size)
        mujoco.mj_getState(self._model, self._data[0], first, kind)
        self._states = np.tile(first, (num_envs, 1))
        self._all_states = np.zeros((num_envs, sizes.unroll * self._n_substeps, size))
        # Each action is held for the physics steps of an environment step.
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (num_envs, sizes.unroll, 2))
        self._controls = np.repeat(wheel_targets(config, actions), self._n_substeps, axis=1)
        self._calls = warm_up(self._time_calls)

    def repeat(self) -> float:
        """Return the environment steps per second of one repeat."""
        seconds = self._time_calls(self._calls)
        return self.num_envs * self._env_steps * self._calls / seconds

    def row(self, repeats: list[float]) -> Row:
        """Return the measured row.

        Raises:
          UserError: Robots are no longer on the floor.
        """
        z = self._states[:, 1 + 2]  # the state begins with time, x, y, z
        if not (np.isfinite(self._states).all() and ((z > Z_RANGE[0]) & (z < Z_RANGE[1])).all()):
            raise UserError(f"{self.rate} at {self.num_envs}: robots are no longer on the floor")
        steps = self._calls * self._env_steps
        return make_row(self.rate, self._n_substeps, self.num_envs, 0.0, repeats, steps)

    def _time_calls(self, calls: int) -> float:
        seconds = 0.0
        for _ in range(calls):
            start = time.perf_counter()
            self._pool.rollout(
                self._model, self._data, self._states, self._controls, state=self._all_states
            )
            seconds += time.perf_counter() - start
            self._states = self._all_states[:, -1].copy()
        return seconds


class Sb3:
    """Stable-Baselines3's PPO with the tutorial's hyperparameters, one robot in C MuJoCo.

    A repeat is one iteration of PPO: 2,560 steps and the update.
    """

    def __init__(self, config: Config, env: Any = None, *, rate: str = "sb3") -> None:
        """Build the environment and the trainer, and run one iteration.

        Args:
          config: The robot, task and physics.
          env: A `gymnasium.Env` or `VecEnv`; None: the robot of `one_robot.py`.
          rate: The name of the row.
        """
        sb3, torch = (importlib.import_module(name) for name in ("stable_baselines3", "torch"))
        # More threads do not speed up networks of this size, and slow them down on a busy machine.
        torch.set_num_threads(1)
        self.rate, self.num_envs = rate, getattr(env, "num_envs", 1)
        self._n_substeps = config.physics.n_substeps
        policy = {
            "activation_fn": torch.nn.Tanh,
            "net_arch": {"pi": _SB3_LAYERS, "vf": _SB3_LAYERS},
        }
        env = as_gymnasium(OneRobot(config)) if env is None else env
        settings = {**_SB3, "n_steps": _SB3_STEPS // self.num_envs}
        self._ppo = sb3.PPO(
            "MlpPolicy", env, policy_kwargs=policy, seed=0, device="cpu", **settings
        )
        self.repeat()

    def repeat(self) -> float:
        """Return the environment steps per second of one iteration."""
        start = time.perf_counter()
        self._ppo.learn(_SB3_STEPS, reset_num_timesteps=False)
        return _SB3_STEPS / (time.perf_counter() - start)

    def row(self, repeats: list[float]) -> Row:
        """Return the measured row."""
        calls = _SB3_STEPS // self.num_envs
        return make_row(self.rate, self._n_substeps, self.num_envs, 0.0, repeats, calls)


def as_gymnasium(robot: OneRobot) -> Any:
    """Wrap one robot in NumPy as a `gymnasium.Env`."""
    gymnasium = importlib.import_module("gymnasium")

    class Env(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (16,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
            del options
            super().reset(seed=seed)
            return robot.reset(self.np_random), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
            return robot.step(action)

    return Env()


def prepare_warp(config: Config, num_envs: int, sizes: Sizes) -> TimedProgram:
    """Compile MJX-Warp's physics with the same C model, under random actions.

    The contacts of all robots share one buffer of as many contacts as MJX has.
    """
    # Build Warp's model and data; its messages about loaded kernels and overflows are disabled.
    warp = importlib.import_module("warp")
    warp.config.log_level = warp.LOG_WARNING
    env, model = make_jetbot_env(config), make_physics_model(config)
    n_substeps = config.physics.n_substeps
    sizes_in_mjx = mjx.make_data(model)._impl
    warp_model = mjx.put_model(model, impl="warp")
    # A GPU would print a line for every robot whose solver used all iterations.
    warp_model = warp_model.tree_replace({"opt._impl.warn_overflow": 0})
    data = mjx.make_data(
        model,
        impl="warp",
        naconmax=num_envs * int(sizes_in_mjx.ncon),
        njmax=int(sizes_in_mjx.nefc),
    )

    # Step all robots under random actions.

    def step_robot(physics: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        stepped = data.replace(**vars(physics), ctrl=ctrl)
        for _ in range(n_substeps):
            stepped = mjx.step(warp_model, stepped)
        return PhysicsState(*(getattr(stepped, name) for name in vars(physics)))

    def step(carry: Carry) -> Carry:
        key, actions = random_actions(carry.key, num_envs)
        physics = jax.vmap(step_robot)(carry.state, jax.vmap(env.wheel_targets)(actions))
        checksum = carry.tally.checksum + sum_per_env(physics)
        return Carry(physics, key, carry.tally._replace(checksum=checksum))

    first = jax.jit(jax.vmap(env.reset))(env_keys(num_envs)).pipeline_state
    return TimedProgram("warp", step, first, n_substeps=n_substeps, calls=sizes.unroll)


def prepare_playground(num_envs: int, sizes: Sizes) -> TimedProgram:
    """Compile an environment of MuJoCo Playground with its training wrappers, random actions.

    The cart-pole has two degrees of freedom and no contacts; the JetBot has eight and four.
    """
    playground = importlib.import_module("mujoco_playground")
    env = playground.registry.load(PLAYGROUND_ENV, config_overrides={"impl": "jax"})
    batch = playground.wrapper.wrap_for_brax_training(env, episode_length=_PLAYGROUND_EPISODE)

    def step(carry: Carry) -> Carry:
        key, actions = random_actions(carry.key, num_envs, env.action_size)
        state = batch.step(carry.state, actions)
        checksum = sum_per_env(
            (state.obs, state.reward, state.done, state.data.qpos, state.data.qvel)
        )
        tally = carry.tally
        return Carry(
            state,
            key,
            Tally(tally.checksum + checksum, tally.episodes + state.done, tally.nonfinite),
        )

    first = jax.jit(batch.reset)(env_keys(num_envs))
    return TimedProgram(
        "playground",
        step,
        first,
        n_substeps=env.n_substeps,
        calls=sizes.unroll,
        check=_check_playground,
    )


def _check_playground(rate: str, carry: Carry) -> None:
    finite: Float[Array, ""] = jnp.isfinite(carry.tally.checksum).all()
    if not finite:
        raise UserError(f"{rate}: states are not finite, so that the rate means nothing")
