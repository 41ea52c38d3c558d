"""The back end of JAX's default device."""

import jax
import pytest

from onekernel import cpu, gpu
from onekernel.backends import default_backend


@pytest.mark.parametrize(
    ("device", "backend"), [("cpu", cpu), ("cuda", gpu), ("gpu", gpu), ("tpu", None)]
)
def test_a_default_device_has_its_back_end(monkeypatch, device, backend):
    class Settings:
        jax_default_device = device

    monkeypatch.setattr(jax, "config", Settings)
    assert default_backend() is backend


@pytest.mark.cpu
def test_without_a_default_device_the_first_one_decides():
    assert default_backend() is cpu
    with jax.default_device(jax.local_devices()[0]):
        assert default_backend() is cpu
