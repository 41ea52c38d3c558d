import jax
import jax.numpy as jnp
import pytest

from jetbot_mjx.compiler import xla_options
from jetbot_mjx.compiler.xla_options import compiler_options, untuned_options
from jetbot_mjx.config import parse_config


def test_what_xla_knows_reaches_it_and_what_it_does_not_know_is_left_out(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(
        xla_options, "_ON_CPU", {"xla_backend_optimization_level": 2, "xla_no_such_thing": True}
    )
    options = compiler_options(parse_config({}))
    assert options == {"xla_backend_optimization_level": 2}
    double = jax.jit(lambda x: 2 * x, compiler_options=options)
    assert float(double(jnp.ones(()))) == 2.0


def test_a_level_of_the_users_own_is_left_alone(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert compiler_options(parse_config({}))["xla_backend_optimization_level"] == 1
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=3")
    assert "xla_backend_optimization_level" not in compiler_options(parse_config({}))


@pytest.mark.cpu
def test_no_library_divides_a_sum_by_the_number_of_cores():
    program = jax.jit(lambda x: (x * x).sum(0), compiler_options=compiler_options(parse_config({})))
    assert "ynn" not in program.lower(jnp.ones((8192, 16))).compile().as_text()


def test_another_refusal_is_not_taken_for_not_knowing():
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_backend_optimization_level"):
        xla_options._is_known("xla_backend_optimization_level", "high")


def test_quick_compiling_is_for_processors_alone(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compiler_options(parse_config({})) == {}


def test_determinism_forbids_atomics_and_timing():
    options = compiler_options(parse_config({"deterministic": True}))
    assert options["xla_gpu_deterministic_ops"] is True
    assert options["xla_gpu_autotune_level"] == 0


def test_only_gpus_time_kernels_and_the_users_level_is_left_alone(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert untuned_options() == {}
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert untuned_options() == {"xla_gpu_autotune_level": 0}
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_autotune_level=4")
    assert untuned_options() == {}
