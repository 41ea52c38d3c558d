"""Replace MJX by C MuJoCo: the same environment in another simulator, for many robots at once.

Only physics is replaced. A compiled program calls back at every environment step with the states of
all robots, and `mujoco.rollout` steps them on the CPU's threads. Goals, actuators, sensors, domain
randomization, reward, termination and episode statistics remain the code of the environment.

The next state of a robot depends on its own state only, so results do not depend on the number of
threads or robots. States are rounded to float32 once per environment step.
"""

import copy
import os
from collections.abc import Mapping
from typing import Literal, NamedTuple

import jax
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float

from jetbot_mjx.config import PhysicsConfig
from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.physics import Physics
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.errors import UserError

_WHOLE_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
_INPUTS = mujoco.mjtState.mjSTATE_CTRL.value | mujoco.mjtState.mjSTATE_MOCAP_POS.value


class Numerics(NamedTuple):
    """A `Numerics` holds solver settings of C MuJoCo, by default all unlike those of training."""

    substeps: int = 8
    """Physics steps per environment step."""
    integrator: Literal["Euler", "implicitfast"] = "implicitfast"
    """Integrator; `Euler` is explicit, without implicit joint damping."""
    cone: Literal["pyramidal", "elliptic"] = "elliptic"
    """Friction cone."""
    solref: tuple[float, float] | None = (0.02, 1.0)
    """Time constant [s] and damping ratio of every contact, MuJoCo's default; None: the model's
    own."""
    solimp: tuple[float, float, float, float, float] | None = (0.9, 0.95, 0.001, 0.5, 2.0)
    """Impedance of every contact, MuJoCo's default; None: the model's own."""
    iterations: int = 100
    """Upper limit of Newton iterations per physics step."""
    ls_iterations: int = 50
    """Upper limit of line-search steps per Newton iteration."""
    tolerance: float = 1e-12
    """Tolerance at which the solver stops earlier."""


OTHER_NUMERICS = Numerics()
"""Numerics for evaluating a policy in a simulator that it was not trained in."""


def training_numerics(physics: PhysicsConfig) -> Numerics:
    """Return the numerics of training, but with a converged solver.

    Args:
      physics: the physics section of the run's configuration.
    """
    return Numerics(
        substeps=physics.n_substeps, integrator="Euler", cone="pyramidal", solref=None, solimp=None
    )


def in_mujoco(
    env: JetBotEnv, numerics: Numerics = OTHER_NUMERICS, *, threads: int | None = None
) -> JetBotEnv:
    """Return the same environment with C MuJoCo as its physics.

    Its programs run on the CPU: compile them within `xla_options.default_device_cpu`. It may be
    wrapped in `DomainRandomizationWrapper`; then each robot has its own `MjModel`.

    Args:
      env: one environment, unwrapped, with the model of its preset.
      numerics: the solver settings of C MuJoCo.
      threads: the number of threads for all robots; None: one per core that the process may use.

    Raises:
      UserError: `JAX_PLATFORMS` excludes the CPU.
    """
    try:
        jax.local_devices(backend="cpu")
    except RuntimeError:
        raise UserError(
            f"JAX_PLATFORMS = {os.environ.get('JAX_PLATFORMS')!r} leaves out the CPU, on which C"
            " MuJoCo runs: add it, as in JAX_PLATFORMS=cuda,cpu"
        ) from None
    # Not every system tells which cores a process may use.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return env.with_physics(MujocoPhysics(env, numerics, threads or cores or 1))


def make_model(env: JetBotEnv, numerics: Numerics) -> mujoco.MjModel:
    """Compile an environment's model for C MuJoCo.

    Args:
      env: one environment, unwrapped.
      numerics: the solver settings of C MuJoCo.

    Returns:
      The model, without visual elements.
    """

    def build_scene(spec: mujoco.MjSpec) -> None:
        env.task.build_scene(spec)
        # Textures are most of a model's memory, and every varied robot copies the model.
        for material in spec.materials:
            material.textures = [""] * len(material.textures)
        for texture in spec.textures:
            spec.delete(texture)

    model = make_mj_model(env.robot, env.config.physics, build_scene=build_scene, visual=False)
    option = model.opt
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    option.timestep = env.dt / numerics.substeps
    option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{numerics.integrator.upper()}")
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{numerics.cone.upper()}")
    option.iterations, option.ls_iterations = numerics.iterations, numerics.ls_iterations
    option.tolerance = numerics.tolerance
    if numerics.solref is not None:
        model.geom_solref[:] = model.pair_solref[:] = numerics.solref
        model.pair_solreffriction[:] = 0.0
    if numerics.solimp is not None:
        model.geom_solimp[:] = model.pair_solimp[:] = numerics.solimp
    return model


class MujocoPhysics(Physics):
    """A model that C MuJoCo steps; pure and unbatched, like `Physics`."""

    def __init__(self, env: JetBotEnv, numerics: Numerics, threads: int) -> None:
        """Build the model and start the threads.

        Args:
          env: the environment whose physics is replaced.
          numerics: the solver settings of C MuJoCo.
          threads: the number of threads, at least 1.
        """
        super().__init__(make_model(env, numerics), env.config.physics)
        self.model = self._base = env.mjx_model
        self._env_dt = env.dt
        self._substeps = numerics.substeps
        self._changed: dict[str, Array] = {}
        """Model arrays that differ from robot to robot, by their names in `MjModel`."""
        self._model_cache = _ModelCache(self.mj_model)
        self._thread_data = [mujoco.MjData(self.mj_model) for _ in range(threads)]
        # 0 means that `rollout` uses the calling thread.
        self._pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def with_model(self, model: mjx.Model) -> "MujocoPhysics":
        """Return a copy of this object with another model.

        Args:
          model: a model of the same structure, for example with another friction.

        Raises:
          UserError: a leaf differs that has no counterpart in C MuJoCo's model.
        """
        other = copy.copy(self)
        other.model, other._changed = model, {}
        before = jax.tree_util.tree_leaves_with_path(self._base)
        for (path, old), new in zip(before, jax.tree.leaves(model), strict=True):
            if new is old:
                continue
            name = jax.tree_util.keystr(path).lstrip(".")
            array = getattr(self.mj_model, name, None)
            if not isinstance(array, np.ndarray) or array.shape != new.shape:
                raise UserError(
                    f"the model's {name} differs from robot to robot: C MuJoCo's model has no such"
                    " array; drive this policy in MJX alone"
                )
            other._changed[name] = new
        return other

    @property
    def impl(self) -> str:
        """Name of the simulator, which is not a value of `physics.impl`."""
        return "mujoco"

    @property
    def may_be_kernel(self) -> bool:
        """Return False: XLA calls back to C MuJoCo."""
        return False

    def step(
        self,
        state: PhysicsState,
        ctrl: Float[Array, " nu"],
        mocap_pos: Float[Array, "nmocap 3"] | None = None,
    ) -> PhysicsState:
        """Integrate one environment step.

        Args:
          state: the state before the step.
          ctrl: wheel speed targets (left, right) [rad/s], constant during the step.
          mocap_pos: positions of the bodies of `mocap_names` [m], world frame; None: their
            positions in the model.

        Returns:
          The state one environment step later. Its `qacc_warmstart` is that of `state`: this
          solver converges without a warm start.
        """
        after = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in (state.qpos, state.qvel))
        qpos, qvel = jax.pure_callback(
            self._step_batch,
            after,
            state.qpos,
            state.qvel,
            ctrl,
            mocap_pos if self.mocap_names else None,
            self._changed,
            vmap_method="broadcast_all",
        )
        return PhysicsState(qpos, qvel, state.qacc_warmstart, state.time + self._env_dt)

    def _step_batch(
        self,
        qpos: Float[Array, "*n nq"],
        qvel: Float[Array, "*n nv"],
        ctrl: Float[Array, "*n nu"],
        mocap_pos: Float[Array, "*n nmocap 3"] | None,
        changed: Mapping[str, Array],
    ) -> tuple[Float[np.ndarray, "*n nq"], Float[np.ndarray, "*n nv"]]:
        """Step all robots; non-finite ones stay non-finite and are not passed to MuJoCo."""
        # Flatten the batch axes.
        batch, model = np.shape(qpos)[:-1], self.mj_model
        count = int(np.prod(batch))
        mocap = model.body_pos[model.body_mocapid >= 0] if mocap_pos is None else mocap_pos
        mocap = np.broadcast_to(mocap, (*batch, model.nmocap, 3)).reshape(count, -1)
        states = np.concatenate([np.asarray(x).reshape(count, -1) for x in (qpos, qvel)], axis=1)
        inputs = np.concatenate([np.asarray(ctrl).reshape(count, -1), mocap], axis=1)
        own = {name: np.asarray(x).reshape(count, -1) for name, x in changed.items()}
        # Step the finite robots.
        numbers = np.concatenate([states, inputs, *own.values()], axis=1)
        finite = np.isfinite(numbers).all(axis=1)
        after = np.full(states.shape, np.nan, np.float32)
        if finite.any():
            models = self._model_cache.models({name: x[finite] for name, x in own.items()})
            after[finite] = self._roll_out(models, states[finite], inputs[finite])
        nq = model.nq
        return after[:, :nq].reshape(*batch, nq), after[:, nq:].reshape(*batch, model.nv)

    def _roll_out(
        self,
        models: list[mujoco.MjModel],
        qpos_qvel: Float[np.ndarray, "n nq+nv"],
        inputs: Float[np.ndarray, "n inputs"],
    ) -> Float[np.ndarray, "n nq+nv"]:
        """Step finite robots with `mujoco.rollout`; a result that diverges becomes NaN."""
        model, count = self.mj_model, len(qpos_qvel)
        # A full state begins with the time, followed by positions and velocities.
        columns = slice(1, 1 + model.nq + model.nv)
        states = np.zeros((count, mujoco.mj_stateSize(model, _WHOLE_STATE)))
        states[:, columns] = qpos_qvel
        substates = np.zeros((count, self._substeps, states.shape[1]))
        self._pool.rollout(
            models or model,
            self._thread_data,
            states,
            inputs[:, None].astype(float),
            control_spec=_INPUTS,
            state=substates,
        )
        after = substates[:, -1, columns]
        after[(np.abs(after) > mujoco.mjMAXVAL).any(axis=1)] = np.nan
        return after


class _ModelCache:
    """A `_ModelCache` holds the models of varied robots from one step to the next."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._preset = model
        self._data = mujoco.MjData(model)
        self._models: dict[bytes, mujoco.MjModel] = {}

    def models(self, changed: Mapping[str, Float[np.ndarray, "n _"]]) -> list[mujoco.MjModel]:
        """Return a model for each robot, or an empty list if all are the preset.

        Args:
          changed: the arrays that differ, by name, one flattened row per robot.
        """
        if not changed:
            return []
        rows = zip(*changed.values(), strict=True)
        previous, self._models = self._models, {}
        models = []
        for row in rows:
            own = dict(zip(changed, row, strict=True))
            key = b"".join(name.encode() + values.tobytes() for name, values in own.items())
            if key not in self._models:
                self._models[key] = previous.get(key) or self._make(own)
            models.append(self._models[key])
        return models

    def _make(self, own: Mapping[str, Float[np.ndarray, " _"]]) -> mujoco.MjModel:
        """Return a copy of the preset's model with other arrays."""
        model = copy.copy(self._preset)
        for name, values in own.items():
            array = getattr(model, name)
            array[:] = values.reshape(array.shape)
        # Recompute the constants that MuJoCo derives from masses and positions.
        mujoco.mj_setConst(model, self._data)
        return model
