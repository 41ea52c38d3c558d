"""Step a MuJoCo model with MJX, as one kernel.

    import jax
    import jax.numpy as jnp
    import mujoco
    from onekernel.mujoco import fuse_mjx

    model = mujoco.MjModel.from_xml_path("hopper.xml")
    step = fuse_mjx(model, n_substeps=4)
    states = jax.vmap(lambda _: step.init())(jnp.arange(4096))
    states = jax.jit(jax.vmap(step))(states, jnp.zeros((4096, model.nu)))

The kernel is `mjx.step`, lowered to scalars for this one model: what follows from the model's
constants alone is computed once, while it is lowered. The constraint solver is MJX's with the
model's own limits (`iterations`, `ls_iterations`, `tolerance`), and its loops end as soon as it has
converged. Results differ from those of `mjx.step` by round-off only, as long as all numbers are
finite. Its derivatives are kernels, too, with that of the solver's optimum (`onekernel.optimum`).

No other module but that one needs MuJoCo and MJX: `pip install mujoco-mjx`.
"""

import contextlib
import dataclasses
import functools
import hashlib
import io
import numbers
import threading
import warnings
from collections.abc import Mapping
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.core import ShapedArray
from jaxtyping import Array, ArrayLike, Bool, Float

from onekernel.backends import Kernel, default_backend
from onekernel.errors import UnsupportedError
from onekernel.fused import derivatives_of
from onekernel.kernel import is_debugging
from onekernel.lower import LateProgram, ScalarProgram, scalarize, word_shape

# MJX prints two lines where its optional part Warp is not installed.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

    from onekernel.optimum import SOLUTION, differentiable_solver

__all__ = ["FusedMjx", "MjxState", "fuse_mjx"]

Fields = dict[str, Array]
"""Fields of `mjx.Data`, by name."""

Shapes = dict[str, jax.ShapeDtypeStruct]
"""Shapes and dtypes of fields, by name."""

OnUnsupported = Literal["warn", "xla", "raise"]

_CARRIED = ("qpos", "qvel", "act", "qacc_warmstart", "time")
"""What a step changes."""

_HELD = ("mocap_pos", "mocap_quat", "eq_active")
"""The rest of a state."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MjxState:
    """A `MjxState` holds what a step of one instance needs to know of the past, and no more.

    The fields are those of `mjx.Data`: float32 but for `eq_active`, and float64 where the step was
    made under `jax_enable_x64`. What a model does not have has size 0.
    """

    qpos: Float[Array, " nq"]
    """Generalised position [m, rad, and quaternions (w, x, y, z)]."""
    qvel: Float[Array, " nv"]
    """Generalised velocity [m/s, rad/s]."""
    act: Float[Array, " na"]
    """Activation of the actuators that have one."""
    qacc_warmstart: Float[Array, " nv"]
    """Acceleration of the last physics step, from which the constraint solver starts."""
    time: Float[Array, ""]
    """Simulated time [s]."""
    mocap_pos: Float[Array, "nmocap 3"]
    """Positions of mocap bodies [m]; a step does not change them."""
    mocap_quat: Float[Array, "nmocap 4"]
    """Orientations of mocap bodies; a step does not change them."""
    eq_active: Bool[Array, " neq"]
    """Which equality constraints are active; a step does not change it."""

    def replace(self, **changes: Any) -> "MjxState":
        """Return a state with other values of some fields."""
        return dataclasses.replace(self, **changes)


class FusedMjx:
    """A `FusedMjx` steps one instance of a model; `fuse_mjx` makes it, and `jax.vmap` batches it.

    The step is lowered when it is first compiled, and so are its derivatives.
    """

    def __init__(
        self, mj_model: mujoco.MjModel, n_substeps: int, on_unsupported: OnUnsupported
    ) -> None:
        """Prepare a step; `fuse_mjx` describes the arguments."""
        self.mj_model, self.n_substeps = mj_model, n_substeps
        self._on_unsupported = on_unsupported
        # The caller may be tracing a function: the model must be known nevertheless.
        with jax.ensure_compile_time_eval():
            try:
                self.model = _uncommitted(mjx.put_model(mj_model))
                self._data = _uncommitted(mjx.make_data(mj_model))
            except NotImplementedError as error:
                reason = " ".join(str(error).split())
                raise UnsupportedError(f"MJX cannot step this model: {reason}") from None
        # What is in `MjData` after a reset, such as the positions of mocap bodies.
        self._first = mujoco.MjData(mj_model)
        self._kernels: dict[tuple[str, ...], Kernel] = {}
        self._warned: set[str] = set()
        # Programs are traced in several threads; only one of them lowers the step.
        self._lock = threading.RLock()

    def init(self, qpos: ArrayLike | None = None, qvel: ArrayLike | None = None) -> MjxState:
        """Return a state at time 0; all other fields are as after `mujoco.mj_resetData`.

        Args:
          qpos: generalised position, shape (nq,); None: `qpos0` of the model.
          qvel: generalised velocity, shape (nv,); None: 0.

        Raises:
          ValueError: a shape is wrong.
        """
        first = {name: getattr(self._first, name) for name in (*_CARRIED, *_HELD)}
        given = {name: x for name, x in (("qpos", qpos), ("qvel", qvel)) if x is not None}
        return MjxState(**self._checked({**first, **given}))

    def __call__(
        self,
        state: MjxState,
        ctrl: ArrayLike,
        *,
        qfrc_applied: ArrayLike | None = None,
        xfrc_applied: ArrayLike | None = None,
    ) -> MjxState:
        """Make `n_substeps` physics steps under constant controls and forces.

        Args:
          state: the state of one instance.
          ctrl: controls of the actuators, shape (nu,).
          qfrc_applied: generalised forces [N, N·m], shape (nv,); None: 0.
          xfrc_applied: forces [N] and torques [N·m] on the centres of mass of the bodies, world
            frame, shape (nbody, 6); None: 0.

        Returns:
          The state `n_substeps` times `opt.timestep` later.

        Raises:
          ValueError: an array does not have the shape of one instance.
          UnsupportedError: there is no kernel, and `on_unsupported` is `raise`.
        """
        inputs = {"ctrl": ctrl, "qfrc_applied": qfrc_applied, "xfrc_applied": xfrc_applied}
        given = {name: x for name, x in inputs.items() if x is not None}
        fields = self._checked({**vars(state), **given})
        # A kernel takes floats only, and nothing of size 0.
        words = {name: jnp.asarray(x, self._dtype) for name, x in fields.items() if x.size}
        carry = {name: x for name, x in words.items() if name in _CARRIED}
        held = {name: x for name, x in words.items() if name not in _CARRIED}
        kernel = self._find_kernel((*held,))
        if self._on_unsupported == "raise" and kernel.unsupported:
            raise kernel.unsupported
        step = self._watched_step if is_debugging() else kernel.as_step()
        return MjxState(**{name: fields[name] for name in vars(state)} | step(carry, held))

    @property
    def kernel(self) -> Kernel | None:
        """Return the kernel of a step without applied forces; None: there is none."""
        kernel = self._find_kernel(self._held)
        return None if kernel.unsupported else kernel

    @property
    def obstacle(self) -> str | None:
        """Return why XLA compiles the step on JAX's default device; None: it is one kernel."""
        if error := self._find_kernel(self._held).unsupported:
            return f"one kernel cannot do {error}"
        backend = default_backend()
        return "there is no back end for this device" if backend is None else backend.obstacle()

    def to_data(self, state: MjxState, ctrl: ArrayLike | None = None) -> mjx.Data:
        """Return MJX's data of a state.

        What follows from the state, such as the positions of bodies, is not computed: that is what
        `forward` does.

        Args:
          state: the state of one instance.
          ctrl: controls of the actuators, shape (nu,); None: 0.
        """
        controls = {} if ctrl is None else {"ctrl": ctrl}
        return self._data.replace(**self._checked({**vars(state), **controls}))

    def forward(self, state: MjxState, ctrl: ArrayLike | None = None) -> mjx.Data:
        """Return MJX's data with all that follows from a state, as `mjx.forward` computes it.

        In a function that `onekernel.fuse` compiles, only what is used of it is computed: positions
        of sites (`site_xpos`), sensors (`sensordata`), contacts (`_impl.contact`) and more.

        Args:
          state: the state of one instance.
          ctrl: controls of the actuators, shape (nu,); None: 0.
        """
        with jax.default_matmul_precision("highest"):
            return mjx.forward(self.model, self.to_data(state, ctrl))

    def from_data(self, data: mjx.Data) -> MjxState:
        """Return the state in MJX's data. Controls and applied forces are not part of it."""
        fields = {name: getattr(data, name) for name in (*_CARRIED, *_HELD)}
        return MjxState(**self._checked(fields))

    @property
    def _dtype(self) -> np.dtype:
        return self._data.qpos.dtype

    def _checked(self, fields: Mapping[str, ArrayLike]) -> Fields:
        """Return fields as arrays of the dtypes that MJX's data has.

        Raises:
          ValueError: a shape is wrong, or `jax_enable_x64` is not as it was for the model.
        """
        if (now := jax.dtypes.canonicalize_dtype(np.float64)) != self._dtype:
            raise ValueError(
                f"the step was made for {self._dtype}, but jax_enable_x64 now asks for {now}"
            )
        arrays = {}
        for name, x in fields.items():
            like = getattr(self._data, name)
            arrays[name] = jnp.asarray(x, like.dtype)
            if arrays[name].shape != like.shape:
                raise ValueError(
                    f"{name} has the shape {arrays[name].shape}, not {like.shape}, which one"
                    " instance of this model has; jax.vmap steps several"
                )
        return arrays

    def _substep(self, carry: Fields, held: Fields) -> Fields:
        """Make one physics step with MJX.

        Args:
          carry: the fields of `_CARRIED` before the step.
          held: other fields that are given.

        Returns:
          The fields of `carry` after the step.
        """
        fields = {**carry, **held}
        if "eq_active" in held:
            fields["eq_active"] = held["eq_active"] != 0
        # By default GPUs multiply float32 matrices in TF32, with which the contact solver diverges.
        with jax.default_matmul_precision("highest"):
            data = mjx.step(self.model, self._data.replace(**fields))
        return {name: getattr(data, name) for name in carry}

    def _lowered(self, carry: Shapes, held: Shapes) -> ScalarProgram:
        """Lower one physics step, in any thread, with the setting for 64 bits of its model."""
        with jax.enable_x64(self._dtype == np.float64):
            skips = jax.default_backend() == "gpu"
            return scalarize(self._substep, carry, held, words=True, skips=skips)

    def _xla_step(self, carry: Fields, held: Fields) -> Fields:
        """Make all physics steps with a loop that XLA compiles."""
        return jax.lax.fori_loop(0, self.n_substeps, lambda _, x: self._substep(x, held), carry)

    def _watched_step(self, carry: Fields, held: Fields) -> Fields:
        """Make all physics steps so that JAX names the operation of a NaN, also of a derivative."""
        with differentiable_solver():
            return self._xla_step(carry, held)

    def _differentiable_step(self, carry: Fields, held: Fields) -> Fields:
        """Make all physics steps with a loop that JAX can differentiate.

        Only the state and the acceleration of each physics step are stored for the derivative.
        """

        # All else is computed again: that takes a kernel less time than to store and load it.
        @functools.partial(
            jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(SOLUTION)
        )
        def substep(carry: Fields, held: Fields) -> Fields:
            with differentiable_solver():
                return self._substep(carry, held)

        if self.n_substeps == 1:
            return substep(carry, held)
        return jax.lax.scan(
            lambda carry, _: (substep(carry, held), None), carry, length=self.n_substeps
        )[0]

    @property
    def _held(self) -> tuple[str, ...]:
        """Return the names of what is given to a step without applied forces, and held."""
        return tuple(x for x in (*_HELD, "ctrl") if getattr(self._data, x).size)

    def _find_kernel(self, held: tuple[str, ...]) -> Kernel:
        """Return the kernel for some given fields, which is made once."""
        with self._lock:
            if held not in self._kernels:
                self._kernels[held] = self._make_kernel(held)
            return self._kernels[held]

    def _make_kernel(self, held: tuple[str, ...]) -> Kernel:
        """Return a kernel that repeats a physics step `n_substeps` times; it is lowered later."""

        def shapes(names: tuple[str, ...]) -> Shapes:
            arrays = {name: getattr(self._data, name) for name in names}
            return {
                name: jax.ShapeDtypeStruct(x.shape, self._dtype)
                for name, x in arrays.items()
                if x.size
            }

        arguments = shapes(_CARRIED), shapes(held)
        leaves, structure = jax.tree.flatten(arguments)
        content = np.zeros(mujoco.mj_sizeModel(self.mj_model), np.uint8)
        mujoco.mj_saveModel(self.mj_model, None, content)
        shapes_of_words = [word_shape(x.shape, self._dtype) for x in leaves]
        program = LateProgram(
            lambda: self._lowered(*arguments),
            shapes_of_words,
            shapes_of_words[: len(arguments[0])],
        )

        def inline(*leaves: Array) -> list[Array]:
            carry, held = jax.tree.unflatten(structure, leaves)
            return jax.tree.leaves(self._differentiable_step(carry, held))

        digest = hashlib.sha256(content.tobytes()).hexdigest()
        identity = f"mjx.step {digest} {self._dtype} {held}"
        kernel = Kernel(
            program,
            carried=len(arguments[0]),
            steps=self.n_substeps,
            fallback=lambda *leaves: jax.tree.leaves(
                self._xla_step(*jax.tree.unflatten(structure, leaves))
            ),
            on_fallback=self._warn_once,
            inline=inline,
            argument_dtypes=[self._dtype] * len(leaves),
            result_dtypes=[self._dtype] * len(arguments[0]),
            identity=identity,
        )
        avals = [ShapedArray(x.shape, x.dtype) for x in leaves]
        kernel.derivatives = derivatives_of(
            inline,
            avals,
            avals[: len(arguments[0])],
            explain=kernel.explain,
            report=self._report_derivative,
            on_fallback=self._warn_of_derivative,
        )
        return kernel

    def _report_derivative(self, error: UnsupportedError) -> None:
        """Do what the user wants where a derivative of the step is not one kernel."""
        if self._on_unsupported == "raise":
            raise error
        self._warn_of_derivative(f"one kernel cannot do {error}")

    def _warn_of_derivative(self, reason: str) -> None:
        """Warn that XLA compiles the derivative, once: a part forward and one backward are slow."""
        what = "the derivative of mjx.step"
        self._warn(f"XLA compiles {what}, which is slower: {reason}", what)

    def _warn_once(self, reason: str) -> None:
        """Warn that XLA compiles the step, once for each reason."""
        self._warn(f"XLA compiles mjx.step, which is slower: {reason}", reason)

    def _warn(self, message: str, about: str) -> None:
        if self._on_unsupported == "warn" and about not in self._warned:
            self._warned.add(about)
            warnings.warn(message, stacklevel=5)


def fuse_mjx(
    mj_model: mujoco.MjModel, n_substeps: int = 1, *, on_unsupported: OnUnsupported = "warn"
) -> FusedMjx:
    """Return a function that steps a model with MJX, as one kernel if it can be.

    Otherwise XLA compiles `mjx.step`, with the same results: the model is too large for one kernel,
    MJX uses an operation for it that cannot be lowered, or this machine has no back end.

    Args:
      mj_model: the model. Later changes of it have no effect.
      n_substeps: number of physics steps in a step.
      on_unsupported: what to do where a step is not one kernel. `warn`: warn once, with the reason.
        `xla`: say nothing. `raise`: raise an error if the model cannot be lowered.

    Returns:
      A function `step(state, ctrl)` of one instance that returns the next state. `step.init` makes
      a state.

    Raises:
      UnsupportedError: MJX cannot step this model.
      TypeError: `mj_model` is not a compiled model of MuJoCo's.
      ValueError: another argument is wrong.
    """
    if not isinstance(mj_model, mujoco.MjModel):
        raise TypeError(f"mj_model is a {type(mj_model).__name__}, not a mujoco.MjModel")
    whole = isinstance(n_substeps, numbers.Integral) and not isinstance(n_substeps, bool)
    if not whole or n_substeps < 1:
        raise ValueError(f"n_substeps is {n_substeps!r}, not a whole number of at least 1")
    if on_unsupported not in get_args(OnUnsupported):
        raise ValueError(f"on_unsupported is {on_unsupported!r}, not warn, xla or raise")
    return FusedMjx(mj_model, int(n_substeps), on_unsupported)


def _uncommitted(tree: Any) -> Any:
    """Return arrays that JAX may move to any device."""
    return jax.device_put(jax.tree.map(np.asarray, tree))
