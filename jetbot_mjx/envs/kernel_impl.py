"""Choose what computes physics and images: one kernel, or XLA."""

import functools
import threading
from collections.abc import Callable, Hashable

from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import Fallback, report
from onekernel import Kernel, KernelError, UnsupportedError, default_backend
from onekernel.build import BACKENDS, Backend


class KernelImpl:
    """A `KernelImpl` is a setting that chooses the implementation, with its value and kernels."""

    def __init__(self, setting: str, impl: str) -> None:
        """Hold a setting; no kernel has been looked for yet.

        Args:
          setting: the setting's full key.
          impl: its value: the name of a back end, `auto` or `xla`.
        """
        self.setting, self.impl = setting, impl
        self.kernels: dict[Hashable, Kernel | UnsupportedError] = {}
        """Kernels that were looked for, by what they depend on, or why there is none."""
        self._lock = threading.Lock()

    @property
    def kernel_class(self) -> Callable[..., Kernel]:
        """Return `Kernel` with the settings of this implementation."""
        report, explain = self.report_fallback, self.explain
        return functools.partial(Kernel, impl=self.impl, explain=explain, on_fallback=report)

    def find_kernel(self, key: Hashable, lower: Callable[[], Kernel]) -> Kernel | None:
        """Return a kernel, which is lowered once; None: XLA compiles the computation.

        Args:
          key: what the kernel depends on.
          lower: makes the kernel.

        Raises:
          UserError: the setting requests a kernel, and an operation cannot be lowered.
        """
        if not self.is_available:
            self.report_obstacle()
            return None
        # Programs are traced in several threads; only one of them lowers the kernel.
        with self._lock:
            if key not in self.kernels:
                try:
                    self.kernels[key] = lower()
                except UnsupportedError as error:
                    self.kernels[key] = error
        found = self.kernels[key]
        if isinstance(found, UnsupportedError):
            self.report_unsupported(found)
            return None
        return found

    @property
    def may_be_kernel(self) -> bool:
        """Return whether there may be kernels: there is a back end, and nothing has failed."""
        failed = any(isinstance(one, UnsupportedError) for one in self.kernels.values())
        return self.is_available and not failed

    def require(self) -> None:
        """Raise an error if the setting requests a back end that this process does not have.

        Raises:
          UserError: the requested back end is not available.
        """
        for backend in BACKENDS:
            if self.impl == backend.IMPL and (obstacle := backend.obstacle()):
                raise UserError(f"{self.setting} = {self.impl}: {obstacle}; or choose xla or auto")

    @property
    def is_available(self) -> bool:
        """Return whether this process has a back end that the setting allows, for any device."""
        return any(self._allows(x) and not x.obstacle() for x in BACKENDS)

    @property
    def backend(self) -> Backend | None:
        """Return the back end that runs kernels on JAX's default device; None: XLA does."""
        backend = default_backend()
        is_usable = backend is not None and self._allows(backend) and not backend.obstacle()
        return backend if is_usable else None

    def _allows(self, backend: Backend) -> bool:
        return self.impl in ("auto", backend.IMPL)

    def report_obstacle(self) -> None:
        """Report it if JAX's default device runs no kernels although its platform may."""
        backend = default_backend()
        if self.impl == "auto" and backend is not None and (obstacle := backend.obstacle()):
            self.report_fallback(obstacle)

    def report_fallback(self, reason: str) -> None:
        """Report that XLA computes what the setting is about, and why."""
        report(Fallback(self.setting, reason))

    def report_unsupported(self, error: UnsupportedError) -> None:
        """Report that there is no kernel because an operation cannot be lowered.

        Raises:
          UserError: the setting requests a kernel.
        """
        reason = f"one kernel cannot do {error}"
        if self.impl != "auto":
            raise UserError(f"{self.setting} = {self.impl}: {reason}; choose xla or auto")
        self.report_fallback(f"{reason}: try the versions that its constraints.txt names")

    def explain(self, error: KernelError) -> UserError:
        """Return the user's error for a kernel's."""
        match error.kind:
            case "platform":
                return UserError(f"{self.setting} = {self.impl}: {error}: choose xla or auto")
            case "derivative" if self.setting == "physics.impl":
                return UserError(
                    "physics as one kernel cannot be differentiated: choose physics.impl = xla; for"
                    " jax.grad and other reverse modes also physics.iterations = 1, for MJX's"
                    " solver is a loop"
                )
            case "derivative":
                return UserError(
                    f"an image as one kernel cannot be differentiated: choose {self.setting} = xla"
                )
            case _:
                return UserError(f"{error}: cast it, or choose {self.setting} = xla")
