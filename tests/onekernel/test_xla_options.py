"""Options of XLA: those that it knows, and those that the user has set."""

import jax
import pytest

from onekernel.aot import xla_options
from onekernel.aot.xla_options import untuned_options


def test_another_refusal_is_not_taken_for_not_knowing():
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_backend_optimization_level"):
        xla_options._is_known("xla_backend_optimization_level", "high")


def test_only_gpus_time_kernels_and_the_users_level_is_left_alone(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert untuned_options() == {}
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert untuned_options() == {"xla_gpu_autotune_level": 0}
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_autotune_level=4")
    assert untuned_options() == {}
