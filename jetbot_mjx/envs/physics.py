"""Step the physics of one robot with MJX, compiled by XLA or lowered to one kernel.

Both ways run the same arithmetic, that of `mjx.step`.
"""

import copy
import functools

import jax
import jax.numpy as jnp
import mujoco
from jax.core import Tracer
from jaxtyping import Array, Float

from jetbot_mjx.config import PhysicsConfig
from jetbot_mjx.devices import require_float32
from jetbot_mjx.envs import box_contacts, line_search, mjx
from jetbot_mjx.envs.kernel_impl import KernelImpl
from jetbot_mjx.envs.robot_model import mocap_ids
from jetbot_mjx.envs.state import PhysicsState
from onekernel import Kernel
from onekernel.build import scalarize, unroll_linear_algebra


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
        self.kernel_impl = KernelImpl("physics.impl", config.impl)
        self.kernel_impl.require()

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
        other.kernel_impl = KernelImpl("physics.impl", self._config.impl)
        return other

    @property
    def impl(self) -> str:
        """Implementation that JAX's default device runs: `physics.impl`, with `auto` resolved."""
        backend = self.kernel_impl.backend
        return "xla" if backend is None or self._kernel_step() is None else backend.IMPL

    @property
    def may_be_kernel(self) -> bool:
        """Return whether a step may be one kernel: there is a back end, and nothing has failed."""
        return self.kernel_impl.may_be_kernel

    @functools.cached_property
    def mocap_names(self) -> tuple[str, ...]:
        """Return the names of the solid mocap bodies, which a task places, in MuJoCo's order."""
        return tuple(mocap_ids(self.mj_model))

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
        kernel = self._kernel_step()
        return (self._xla_step if kernel is None else kernel.as_step())(state, consts)

    def _xla_step(self, state: PhysicsState, consts: tuple[Array, list[Array]]) -> PhysicsState:
        """Integrate one environment step with a loop that XLA compiles."""
        substep = self.substep
        if self._config.cholesky == "unrolled":
            substep = unroll_linear_algebra(substep)
        state, _ = jax.lax.scan(
            lambda state, _: (substep(state, consts), None),
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
        data = self._data.replace(**vars(state), ctrl=ctrl)
        if mocap_pos:
            data = data.replace(mocap_pos=mocap_pos[0])
        # By default GPUs multiply float32 matrices in TF32, with which the contact solver diverges.
        # Only physics requires full precision; networks choose their own.
        with (
            jax.default_matmul_precision("highest"),
            line_search.relative_costs(),
            box_contacts.every_corner(),
        ):
            data = mjx.step(jax.tree.unflatten(treedef, leaves), data)
        return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, data.time)

    def _kernel_step(self) -> Kernel | None:
        """Return an environment step as one kernel; None: XLA compiles it on all platforms."""
        return self.kernel_impl.find_kernel("step", self._lower)

    def _lower(self) -> Kernel:
        """Lower one physics step to a kernel that repeats it `n_substeps` times."""
        model, leaves = self.mj_model, jax.tree.leaves(self.model)

        def example() -> tuple[PhysicsState, tuple[Array, list[Array]]]:
            traced = [jnp.zeros(leaves[i].shape, leaves[i].dtype) for i in self._traced_leaves]
            traced += [jnp.zeros((model.nmocap, 3))] if model.nmocap else []
            qpos, qvel = jnp.zeros(model.nq), jnp.zeros(model.nv)
            return PhysicsState(qpos, qvel, qvel, jnp.zeros(())), (jnp.zeros(model.nu), traced)

        # Shapes only: arrays made here would become part of the program that is being traced.
        arguments = jax.eval_shape(example)
        state, _ = arguments
        program = scalarize(self.substep, *arguments)
        structure = jax.tree.structure(arguments)
        return self.kernel_impl.kernel_class(
            program,
            carried=len(jax.tree.leaves(state)),
            steps=self._config.n_substeps,
            fallback=lambda *leaves: jax.tree.leaves(
                self._xla_step(*jax.tree.unflatten(structure, leaves))
            ),
        )
