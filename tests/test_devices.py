"""The options that programs are compiled with."""

import jax
import jax.numpy as jnp
import pytest

from jetbot_mjx import devices
from jetbot_mjx.devices import compiler_options


def test_what_xla_knows_reaches_it_and_what_it_does_not_know_is_left_out(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(
        devices, "_ON_CPU", {"xla_backend_optimization_level": 2, "xla_no_such_thing": True}
    )
    options = compiler_options(deterministic=False)
    assert options == {"xla_backend_optimization_level": 2}
    double = jax.jit(lambda x: 2 * x, compiler_options=options)
    assert float(double(jnp.ones(()))) == 2.0


def test_a_level_of_the_users_own_is_left_alone(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert compiler_options(deterministic=False)["xla_backend_optimization_level"] == 1
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=3")
    assert "xla_backend_optimization_level" not in compiler_options(deterministic=False)


@pytest.mark.cpu
def test_no_library_divides_a_sum_by_the_number_of_cores():
    program = jax.jit(
        lambda x: (x * x).sum(0), compiler_options=compiler_options(deterministic=False)
    )
    assert "ynn" not in program.lower(jnp.ones((8192, 16))).compile().as_text()


def test_quick_compiling_is_for_processors_alone(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compiler_options(deterministic=False) == {}


def test_determinism_forbids_atomics_and_timing():
    options = compiler_options(deterministic=True)
    assert options["xla_gpu_deterministic_ops"] is True
    assert options["xla_gpu_autotune_level"] == 0
