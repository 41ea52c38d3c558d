"""Define the section `physics`: time steps, solver, and how a step is compiled."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from jetbot_mjx.config.section import Section
from jetbot_mjx.config.value_types import Count, Positive

_MAX_SUBSTEPS = 10_000


class PhysicsConfig(Section):
    """Time steps and the solver's accuracy. Integrator: Euler, without implicit joint damping."""

    ctrl_dt: Positive = 1 / 60
    """[s] duration of one environment step, during which an action is held."""
    sim_dt: Annotated[float, Field(ge=1e-5, allow_inf_nan=False)] = 1 / 120
    """[s] duration of one physics step; `ctrl_dt` is a whole multiple of it."""
    tolerance: Annotated[float, Field(ge=0, le=1e-3, allow_inf_nan=False)] = 1e-6
    """The contact solver stops when an iteration improves its cost by less than this, or its
    gradient is smaller, both relative to the trace of the inertia matrix. MuJoCo's default of 1e-8
    is below the resolution of float32."""
    iterations: Count = 20
    """Largest number of Newton iterations per physics step; usually one or two are needed."""
    ls_iterations: Count = 8
    """Largest number of line-search steps per Newton iteration; a slippery floor needs most."""
    cholesky: Literal["unrolled", "library"] = "unrolled"
    """How XLA factorises MJX's matrices. `unrolled`: in scalar arithmetic, as kernels always do;
    `library`: by a call of LAPACK or cuSOLVER, which prevents a step from running as one CUDA
    graph."""
    impl: Literal["auto", "llvm", "ptx", "xla"] = "auto"
    """How a physics step is compiled. `ptx`: as one kernel for NVIDIA GPUs; `llvm`: as one kernel
    for CPUs; `xla`: by XLA, as many kernels; `auto`: as one kernel if that is possible, otherwise
    by XLA."""

    @property
    def n_substeps(self) -> int:
        """Return the number of physics steps per environment step."""
        return round(self.ctrl_dt / self.sim_dt)

    @model_validator(mode="after")
    def _whole_substeps(self) -> Self:
        ratio = self.ctrl_dt / self.sim_dt
        problem = f"sim_dt = {self.sim_dt:g} goes {ratio:g} times into ctrl_dt = {self.ctrl_dt:g}"
        if ratio > _MAX_SUBSTEPS:
            raise ValueError(f"{problem}: make it at most {_MAX_SUBSTEPS} times")
        # A decimal in YAML cannot represent 1/120 exactly: accept a ratio that is nearly whole.
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-3 * ratio:
            nearest = self.ctrl_dt / max(1, round(ratio))
            remedy = f"make the sub-steps whole, for example sim_dt = {nearest:.9g}"
            raise ValueError(f"{problem}: {remedy}")
        return self
