"""The physics of one environment step: MJX's arithmetic, as XLA compiles it or as one kernel."""

import contextlib
import copy
import functools
import threading
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jax.core import Tracer
from jaxtyping import Array, Float

from jetbot_mjx.compiler import kernel, llvm_backend, llvm_codegen, ptx_backend
from jetbot_mjx.compiler.lower_jaxpr import scalarize
from jetbot_mjx.compiler.scalar_ir import UnsupportedError
from jetbot_mjx.config import PhysicsConfig
from jetbot_mjx.envs import cholesky, mjx
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.errors import UserError

BACKENDS: tuple[kernel.Backend, ...] = (ptx_backend, llvm_backend)
"""Who can make a step as one kernel."""

kernel.register(*BACKENDS)

_PLATFORMS = {"gpu": "cuda"}
"""What JAX's devices call a platform that its programs are compiled for under another name."""


class Physics:
    """A model and how it is stepped; pure and unbatched."""

    def __init__(self, mj_model: mujoco.MjModel, config: PhysicsConfig) -> None:
        """Hand the model over to MJX.

        Args:
          mj_model: of what moves and touches.
          config: the physics of the run.

        Raises:
          UserError: one kernel is asked for where there can be none, or JAX computes in 64 bits.
        """
        if jax.config.values["jax_enable_x64"]:
            raise UserError("physics is float32, and JAX_ENABLE_X64 is set: unset it")
        self._mj_model = mj_model
        self._config = config
        self._varied: tuple[int, ...] = ()
        """Leaves of the model that are known only when a program runs, robot by robot."""
        self._lock = threading.Lock()
        self._kernel: kernel.Step | UnsupportedError | None = None
        for backend in BACKENDS:
            if config.impl == backend.IMPL and not backend.is_available():
                raise UserError(
                    f"physics.impl = {config.impl} needs {backend.NEEDS}; this is"
                    f" {jax.default_backend()}: choose xla or auto"
                )

    @functools.cached_property
    def model(self) -> mjx.Model:
        """Return the model that is stepped."""
        return mjx.put_model(self._mj_model)

    @functools.cached_property
    def _data(self) -> mjx.Data:
        """Return the data of which a step replaces what a `PhysicsState` holds."""
        return mjx.make_data(self._mj_model)

    def with_model(self, model: mjx.Model) -> "Physics":
        """Return the same on another model, as a new object.

        Args:
          model: of the same structure, such as one with other friction.

        Returns:
          A copy; `self` stays as it is.
        """
        other = copy.copy(self)
        other.model = model
        leaves = jax.tree.leaves(model)
        other._varied = tuple(i for i, x in enumerate(leaves) if isinstance(x, Tracer))
        other._lock = threading.Lock()
        other._kernel = None
        return other

    @property
    def impl(self) -> str:
        """Return what `physics.impl` is on JAX's default devices; never `auto`."""
        platform = jax.local_devices()[0].platform
        here = [
            x.IMPL for x in self._backends() if _PLATFORMS.get(platform, platform) == x.PLATFORM
        ]
        return "xla" if not here or self._as_kernel() is None else here[0]

    @functools.cached_property
    def mocap_names(self) -> tuple[str, ...]:
        """Solid bodies that stand where a task puts them, in MuJoCo's order."""
        model = self._mj_model
        bodies = [model.body(i) for i in range(model.nbody)]
        placed = sorted((body for body in bodies if body.mocapid[0] >= 0), key=lambda b: b.mocapid)
        return tuple(body.name for body in placed)

    def step(
        self,
        state: PhysicsState,
        ctrl: Float[Array, " nu"],
        mocap_pos: Float[Array, "nmocap 3"] | None = None,
    ) -> PhysicsState:
        """Integrate one environment step, `n_substeps` physics steps.

        Args:
          state: where to start.
          ctrl: wheel speed targets (left, right) [rad/s], held throughout.
          mocap_pos: where the bodies of `mocap_names` stand [m], world frame; None: where the
            model has them.

        Returns:
          The state one `ctrl_dt` later.
        """
        leaves = jax.tree.leaves(self.model)
        traced_leaves = [leaves[place] for place in self._varied]
        if self._mj_model.nmocap:
            places = self._data.mocap_pos if mocap_pos is None else mocap_pos
            traced_leaves.append(jnp.asarray(places, self._data.mocap_pos.dtype))
        held = jnp.asarray(ctrl, state.qpos.dtype), traced_leaves
        return (self._as_kernel() or self._steps)(state, held)

    def _steps(self, state: PhysicsState, held: tuple[Array, list[Array]]) -> PhysicsState:
        """Make all physics steps of an environment step through XLA."""
        state, _ = jax.lax.scan(
            lambda state, _: (self.substep(state, held), None),
            state,
            length=self._config.n_substeps,
        )
        return state

    def substep(self, state: PhysicsState, held: tuple[Array, list[Array]]) -> PhysicsState:
        """Make one step of MJX.

        Args:
          state: where to start.
          held: wheel speed targets (left, right) [rad/s], and what else is known only when a
            program runs: leaves of the model, then, where there are any, the places of solid mocap
            bodies [m].

        Returns:
          The state one `sim_dt` later.
        """
        ctrl, traced_leaves = held
        leaves, treedef = jax.tree.flatten(self.model)
        varied, places = traced_leaves[: len(self._varied)], traced_leaves[len(self._varied) :]
        for place, leaf in zip(self._varied, varied, strict=True):
            leaves[place] = leaf
        data = self._data.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            qacc_warmstart=state.qacc_warmstart,
            time=state.time,
            ctrl=ctrl,
        )
        if places:
            data = data.replace(mocap_pos=places[0])
        factorise = (
            contextlib.nullcontext if self._config.cholesky == "library" else cholesky.unrolled
        )
        # GPUs multiply float32 matrices in TF32 unless told otherwise, and the contact solver
        # then diverges. Only physics asks for full precision; networks choose their own.
        with jax.default_matmul_precision("highest"), factorise():
            data = mjx.step(jax.tree.unflatten(treedef, leaves), data)
        return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, data.time)

    def _backends(self) -> list[kernel.Backend]:
        """Return the back ends that may compile the step as one kernel in this process."""
        return [x for x in BACKENDS if self._config.impl in ("auto", x.IMPL) and x.is_available()]

    def _as_kernel(self) -> kernel.Step | None:
        """Return the step as one kernel; None where XLA makes it on all platforms."""
        if not self._backends():
            return None
        # Programs are traced in several threads; one is enough to write the kernel.
        with self._lock:
            if self._kernel is None:
                try:
                    self._kernel = kernel.as_step(self._written())
                except UnsupportedError as error:
                    self._kernel = error
        if not isinstance(self._kernel, UnsupportedError):
            return self._kernel
        if self._config.impl != "auto":
            raise UserError(
                f"physics.impl = {self._config.impl}: one kernel cannot do {self._kernel};"
                " choose xla or auto"
            )
        return None

    def _written(self) -> kernel.Kernel:
        # Shapes alone: arrays made here would become part of the program that is being traced.
        def numbers(*shape: int) -> Any:
            return jax.ShapeDtypeStruct(shape, jnp.float32)

        model = self._mj_model
        state = PhysicsState(numbers(model.nq), numbers(model.nv), numbers(model.nv), numbers())
        leaves = jax.tree.leaves(self.model)
        traced_leaves = [
            jax.ShapeDtypeStruct(leaves[i].shape, leaves[i].dtype) for i in self._varied
        ]
        traced_leaves += [numbers(model.nmocap, 3)] if model.nmocap else []
        arguments = state, (numbers(model.nu), traced_leaves)
        program = scalarize(self.substep, *arguments)
        llvm_codegen.require(program)
        structure = jax.tree.structure(arguments)
        return kernel.Kernel(
            program,
            carried=len(jax.tree.leaves(state)),
            steps=self._config.n_substeps,
            fallback=lambda *leaves: jax.tree.leaves(
                self._steps(*jax.tree.unflatten(structure, leaves))
            ),
            impl=self._config.impl,
        )
