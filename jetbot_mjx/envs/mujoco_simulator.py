"""C MuJoCo in the place of MJX: the same environment in another simulator, many robots at once.

Only physics changes hands. A compiled program calls back for every environment step, with the
states of all its robots, and `mujoco.rollout` steps them over the CPU's threads. Goals, actuators,
sensors, drawn robots, reward, `advance`, solid bodies, and how episodes end and are counted stay
the environment's own code.

What a robot becomes depends on its own state alone, so no result depends on how many threads or
robots there are. States are rounded to float32 once per environment step.
"""

import copy
import os
from collections.abc import Mapping
from typing import Literal, NamedTuple

import jax
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Bool, Float

from jetbot_mjx.config import PhysicsConfig
from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.physics import Physics
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.errors import UserError

_INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
_CONES = {
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
}
_WHOLE_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
_INPUTS = mujoco.mjtState.mjSTATE_CTRL.value | mujoco.mjtState.mjSTATE_MOCAP_POS.value


class Numerics(NamedTuple):
    """Settings of C MuJoCo. The defaults share none of the choices that training makes."""

    substeps: int = 8
    """Physics steps per environment step."""
    integrator: Literal["Euler", "implicitfast"] = "implicitfast"
    """`Euler` is explicit: without implicit joint damping."""
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
    """Where the solver stops before."""


OTHER_NUMERICS = Numerics()
"""Those by which a policy is shown to drive elsewhere."""


def training_numerics(physics: PhysicsConfig) -> Numerics:
    """Return the numerics that a policy is trained with, but with a converged solver.

    Args:
      physics: of the run.
    """
    return Numerics(
        substeps=physics.n_substeps,
        integrator="Euler",
        cone="pyramidal",
        solref=None,
        solimp=None,
    )


def in_mujoco(
    env: JetBotEnv, numerics: Numerics = OTHER_NUMERICS, *, threads: int | None = None
) -> JetBotEnv:
    """Return the same environment with C MuJoCo as its physics.

    Its programs run on the CPU: compile them within `xla_options.default_device_cpu`.
    `DomainRandomizationWrapper` may wrap it; each robot then gets an `MjModel` of its own.

    Args:
      env: one environment, unwrapped, with its preset's model.
      numerics: how C MuJoCo computes.
      threads: for all robots together; None: one for each core that this process may use.

    Raises:
      UserError: JAX was told to do without a CPU.
    """
    try:
        jax.local_devices(backend="cpu")
    except RuntimeError:
        raise UserError(
            f"JAX_PLATFORMS = {os.environ.get('JAX_PLATFORMS')!r} leaves out the CPU, on which C"
            " MuJoCo runs: add it, as in JAX_PLATFORMS=cuda,cpu"
        ) from None
    return env.with_physics(MujocoPhysics(env, numerics, threads or _cores()))


def make_model(env: JetBotEnv, numerics: Numerics) -> mujoco.MjModel:
    """Compile an environment's model for C MuJoCo.

    Args:
      env: one environment, unwrapped.
      numerics: how C MuJoCo is to compute.

    Returns:
      The model, without what only shows.
    """

    def build_scene(spec: mujoco.MjSpec) -> None:
        env.task.build_scene(spec)
        # Textures are a hundred times as large as the rest, and every drawn robot is a copy.
        for material in spec.materials:
            material.textures = [""] * len(material.textures)
        for texture in spec.textures:
            spec.delete(texture)

    model = make_mj_model(env.robot, env.config.physics, build_scene=build_scene, visual=False)
    option = model.opt
    option.timestep = env.dt / numerics.substeps
    option.integrator = _INTEGRATORS[numerics.integrator]
    option.cone = _CONES[numerics.cone]
    option.iterations, option.ls_iterations = numerics.iterations, numerics.ls_iterations
    option.tolerance = numerics.tolerance
    # A state that is not finite is for the wrappers to count; MuJoCo would put the robot back.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if numerics.solref is not None:
        model.geom_solref[:] = model.pair_solref[:] = numerics.solref
        model.pair_solreffriction[:] = 0.0
    if numerics.solimp is not None:
        model.geom_solimp[:] = model.pair_solimp[:] = numerics.solimp
    return model


class MujocoPhysics(Physics):
    """A model and how C MuJoCo steps it; pure and unbatched."""

    def __init__(self, env: JetBotEnv, numerics: Numerics, threads: int) -> None:
        """Build the model and starts the threads.

        Args:
          env: whose physics this is to be.
          numerics: how C MuJoCo computes.
          threads: at least 1.
        """
        self._c_model = make_model(env, numerics)
        super().__init__(self._c_model, env.config.physics)
        self.model = self._base = env.mjx_model
        self._env_dt = env.dt
        self._substeps = numerics.substeps
        self._changed: dict[str, Array] = {}
        """Arrays of the model that a robot has its own of, by their names in `MjModel`."""
        self._robots = _Robots(self._c_model)
        self._thread_data = [mujoco.MjData(self._c_model) for _ in range(threads)]
        # MuJoCo takes 0 for the calling thread.
        self._pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def with_model(self, model: mjx.Model) -> "MujocoPhysics":
        """Return the same on another model, as a new object.

        Args:
          model: of the same structure, such as one with other friction.

        Raises:
          UserError: something differs that C MuJoCo's model does not have.
        """
        other = copy.copy(self)
        other.model, other._changed = model, {}
        before = jax.tree_util.tree_leaves_with_path(self._base)
        for (path, old), new in zip(before, jax.tree.leaves(model), strict=True):
            if new is old:
                continue
            name = jax.tree_util.keystr(path).lstrip(".")
            held = getattr(self._c_model, name, None)
            if not isinstance(held, np.ndarray) or held.shape != new.shape:
                raise UserError(
                    f"the model's {name} differs from robot to robot: C MuJoCo's model has no such"
                    " array; drive this policy in MJX alone"
                )
            other._changed[name] = new
        return other

    @property
    def impl(self) -> str:
        """Return the name of the simulator; no value of `physics.impl`."""
        return "mujoco"

    def step(
        self,
        state: PhysicsState,
        ctrl: Float[Array, " nu"],
        mocap_pos: Float[Array, "nmocap 3"] | None = None,
    ) -> PhysicsState:
        """Integrate one environment step.

        Args:
          state: where to start.
          ctrl: wheel speed targets (left, right) [rad/s], held throughout.
          mocap_pos: where the bodies of `mocap_names` stand [m], world frame; None: where the
            model has them.

        Returns:
          The state one environment step later. The solver needs no warm start to converge: that
          of `state` is passed on.
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
        """Step all robots; those that are not finite stay so, and are not shown to MuJoCo."""
        batch, model = np.shape(qpos)[:-1], self._c_model
        count = int(np.prod(batch))
        places = model.body_pos[model.body_mocapid >= 0] if mocap_pos is None else mocap_pos
        places = np.broadcast_to(places, (*batch, model.nmocap, 3)).reshape(count, -1)
        moving = np.concatenate([np.asarray(x).reshape(count, -1) for x in (qpos, qvel)], axis=1)
        inputs = np.concatenate([np.asarray(ctrl).reshape(count, -1), places], axis=1)
        own = {name: np.asarray(x).reshape(count, -1) for name, x in changed.items()}
        good = _is_finite(moving, inputs, *own.values())
        moved = np.full(moving.shape, np.nan, np.float32)
        if good.any():
            models = self._robots.models({name: x[good] for name, x in own.items()})
            moved[good] = self._roll_out(models, moving[good], inputs[good])
        nq = model.nq
        return moved[:, :nq].reshape(*batch, nq), moved[:, nq:].reshape(*batch, model.nv)

    def _roll_out(
        self,
        models: list[mujoco.MjModel],
        moving: Float[np.ndarray, "n nq+nv"],
        inputs: Float[np.ndarray, "n inputs"],
    ) -> Float[np.ndarray, "n nq+nv"]:
        model, count = self._c_model, len(moving)
        # The time comes first, then positions and velocities.
        place = slice(1, 1 + model.nq + model.nv)
        states = np.zeros((count, mujoco.mj_stateSize(model, _WHOLE_STATE)))
        states[:, place] = moving
        every = np.zeros((count, self._substeps, states.shape[1]))
        self._pool.rollout(
            models or model,
            self._thread_data,
            states,
            inputs[:, None].astype(float),
            control_spec=_INPUTS,
            state=every,
        )
        after = every[:, -1, place]
        after[(np.abs(after) > mujoco.mjMAXVAL).any(axis=1)] = np.nan
        return after


class _Robots:
    """The models of robots that differ from their preset, kept from one step to the next."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._preset = model
        self._data = mujoco.MjData(model)
        self._models: dict[bytes, mujoco.MjModel] = {}

    def models(self, changed: Mapping[str, Float[np.ndarray, "n _"]]) -> list[mujoco.MjModel]:
        """Return a model for each robot, or none where all are the preset's."""
        if not changed:
            return []
        rows = zip(*changed.values(), strict=True)
        kept, self._models = self._models, {}
        found = []
        for row in rows:
            own = dict(zip(changed, row, strict=True))
            key = b"".join(name.encode() + values.tobytes() for name, values in own.items())
            if key not in self._models:
                self._models[key] = kept.get(key) or self._make(own)
            found.append(self._models[key])
        return found

    def _make(self, own: Mapping[str, Float[np.ndarray, " _"]]) -> mujoco.MjModel:
        model = copy.copy(self._preset)
        for name, values in own.items():
            held = getattr(model, name)
            held[:] = values.reshape(held.shape)
        # What MuJoCo derives from masses and places when it compiles a model.
        mujoco.mj_setConst(model, self._data)
        return model


def _is_finite(*columns: Float[np.ndarray, "n _"]) -> Bool[np.ndarray, " n"]:
    return np.asarray(np.isfinite(np.concatenate(columns, axis=1)).all(axis=1))


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
