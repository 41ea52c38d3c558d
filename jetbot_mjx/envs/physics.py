"""Step the physics of one robot with MJX, compiled by XLA or lowered to one kernel.

Both ways run the same arithmetic, that of `mjx.step`.
"""

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

from jetbot_mjx.compiler import kernel, llvm_codegen
from jetbot_mjx.compiler.backends import (
    available_backends,
    default_backend,
    obstacle,
    require_backend,
    require_float32,
)
from jetbot_mjx.compiler.lower_jaxpr import scalarize
from jetbot_mjx.compiler.scalar_ir import UnsupportedError
from jetbot_mjx.config import PhysicsConfig
from jetbot_mjx.envs import cholesky, line_search, mjx
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import Fallback, report


class Physics:
    """A model and a way to step it; pure and unbatched."""

    def __init__(self, mj_model: mujoco.MjModel, config: PhysicsConfig) -> None:
        """Prepare the physics; the MJX model is built at its first use.

        Args:
          mj_model: the C model, without visual elements.
          config: the physics section of the configuration.

        Raises:
          UserError: the requested kernel back end is not available, or JAX computes in 64 bits.
        """
        require_float32()
        self.mj_model = mj_model
        self._config = config
        self._traced_leaves: tuple[int, ...] = ()
        """Indices of the model's leaves that are traced: they may differ from robot to robot."""
        self._lock = threading.Lock()
        self._kernel: kernel.Step | UnsupportedError | None = None
        require_backend(config.impl, "physics.impl")

    @functools.cached_property
    def model(self) -> mjx.Model:
        """Return the MJX model that is stepped."""
        return mjx.put_model(self.mj_model)

    @functools.cached_property
    def _data(self) -> mjx.Data:
        """Template of the simulation data; a step replaces the fields of `PhysicsState`."""
        return mjx.make_data(self.mj_model)

    def with_model(self, model: mjx.Model) -> "Physics":
        """Return a copy of this object with another model.

        Args:
          model: a model of the same structure, for example with another friction. Leaves may be
            traced.
        """
        other = copy.copy(self)
        other.model = model
        leaves = jax.tree.leaves(model)
        other._traced_leaves = tuple(i for i, x in enumerate(leaves) if isinstance(x, Tracer))
        other._lock = threading.Lock()
        other._kernel = None
        return other

    @property
    def impl(self) -> str:
        """Implementation that JAX's default device runs: `physics.impl`, with `auto` resolved."""
        backend = default_backend(self._config.impl)
        return "xla" if backend is None or self._kernel_step() is None else backend.IMPL

    @property
    def may_be_kernel(self) -> bool:
        """Return whether a step may be one kernel: there is a back end, and nothing has failed."""
        failed = isinstance(self._kernel, UnsupportedError)
        return bool(available_backends(self._config.impl)) and not failed

    @functools.cached_property
    def mocap_names(self) -> tuple[str, ...]:
        """Return the names of the solid mocap bodies, which a task places, in MuJoCo's order."""
        model = self.mj_model
        bodies = [model.body(i) for i in range(model.nbody)]
        mocap = sorted((body for body in bodies if body.mocapid[0] >= 0), key=lambda b: b.mocapid)
        return tuple(body.name for body in mocap)

    def step(
        self,
        state: PhysicsState,
        ctrl: Float[Array, " nu"],
        mocap_pos: Float[Array, "nmocap 3"] | None = None,
    ) -> PhysicsState:
        """Integrate one environment step, `n_substeps` physics steps.

        Args:
          state: the state before the step.
          ctrl: wheel speed targets (left, right) [rad/s], constant during the step.
          mocap_pos: positions of the bodies of `mocap_names` [m], world frame; None: their
            positions in the model.

        Returns:
          The state one `ctrl_dt` later.
        """
        leaves = jax.tree.leaves(self.model)
        arrays = [leaves[index] for index in self._traced_leaves]
        if self.mj_model.nmocap:
            positions = self._data.mocap_pos if mocap_pos is None else mocap_pos
            arrays.append(jnp.asarray(positions, self._data.mocap_pos.dtype))
        consts = jnp.asarray(ctrl, state.qpos.dtype), arrays
        return (self._kernel_step() or self._xla_step)(state, consts)

    def _xla_step(self, state: PhysicsState, consts: tuple[Array, list[Array]]) -> PhysicsState:
        """Integrate one environment step with a loop that XLA compiles."""
        state, _ = jax.lax.scan(
            lambda state, _: (self.substep(state, consts), None),
            state,
            length=self._config.n_substeps,
        )
        return state

    def substep(self, state: PhysicsState, consts: tuple[Array, list[Array]]) -> PhysicsState:
        """Make one physics step with MJX.

        Args:
          state: the state before the step.
          consts: what is constant during an environment step: the wheel speed targets (left, right)
            [rad/s], and a list with the traced leaves of the model, followed by the positions of
            the solid mocap bodies [m] if there are any.

        Returns:
          The state one `sim_dt` later.
        """
        # Insert the traced leaves into the model.
        ctrl, arrays = consts
        leaves, treedef = jax.tree.flatten(self.model)
        count = len(self._traced_leaves)
        traced, mocap_pos = arrays[:count], arrays[count:]
        for index, leaf in zip(self._traced_leaves, traced, strict=True):
            leaves[index] = leaf
        # Build the simulation data from the state.
        data = self._data.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            qacc_warmstart=state.qacc_warmstart,
            time=state.time,
            ctrl=ctrl,
        )
        if mocap_pos:
            data = data.replace(mocap_pos=mocap_pos[0])
        factorise = (
            contextlib.nullcontext if self._config.cholesky == "library" else cholesky.unrolled
        )
        # By default GPUs multiply float32 matrices in TF32, with which the contact solver diverges.
        # Only physics requires full precision; networks choose their own.
        with (
            jax.default_matmul_precision("highest"),
            line_search.relative_costs(),
            factorise(),
        ):
            data = mjx.step(jax.tree.unflatten(treedef, leaves), data)
        return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, data.time)

    def _kernel_step(self) -> kernel.Step | None:
        """Return an environment step as one kernel; None: XLA compiles it on all platforms."""
        if not available_backends(self._config.impl):
            if reason := obstacle(self._config.impl):
                report(Fallback("physics.impl", reason))
            return None
        # Programs are traced in several threads; only one of them lowers the kernel.
        with self._lock:
            if self._kernel is None:
                try:
                    self._kernel = kernel.as_step(self._lower())
                except UnsupportedError as error:
                    self._kernel = error
        if not isinstance(self._kernel, UnsupportedError):
            return self._kernel
        reason = f"one kernel cannot do {self._kernel}"
        if self._config.impl != "auto":
            raise UserError(f"physics.impl = {self._config.impl}: {reason}; choose xla or auto")
        report(
            Fallback("physics.impl", f"{reason}: try the versions that its constraints.txt names")
        )
        return None

    def _lower(self) -> kernel.Kernel:
        """Lower one physics step to a kernel that repeats it `n_substeps` times."""

        # Shapes only: arrays made here would become part of the program that is being traced.
        def array(*shape: int) -> Any:
            return jax.ShapeDtypeStruct(shape, jnp.float32)

        model = self.mj_model
        state = PhysicsState(array(model.nq), array(model.nv), array(model.nv), array())
        leaves = jax.tree.leaves(self.model)
        traced = [
            jax.ShapeDtypeStruct(leaves[i].shape, leaves[i].dtype) for i in self._traced_leaves
        ]
        traced += [array(model.nmocap, 3)] if model.nmocap else []
        arguments = state, (array(model.nu), traced)
        program = scalarize(self.substep, *arguments)
        llvm_codegen.require(program)
        structure = jax.tree.structure(arguments)
        return kernel.Kernel(
            program,
            carried=len(jax.tree.leaves(state)),
            steps=self._config.n_substeps,
            fallback=lambda *leaves: jax.tree.leaves(
                self._xla_step(*jax.tree.unflatten(structure, leaves))
            ),
            impl=self._config.impl,
        )
