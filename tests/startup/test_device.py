"""NVIDIA's driver is opened early where JAX may use it, and nowhere else."""

import threading

import pytest

from jetbot_mjx.startup import device


@pytest.mark.parametrize(
    ("platforms", "opened"),
    [(None, True), ("cuda", True), ("gpu,cpu", True), ("cpu", False), ("tpu,cpu", False)],
)
def test_the_driver_is_opened_where_jax_may_use_it(monkeypatch, platforms, opened):
    calls, threads = [], []

    class Driver:
        def __init__(self, name):
            calls.append(name)

        def cuInit(self, flags):
            calls.append(flags)

    class Thread(threading.Thread):
        def start(self):
            super().start()
            threads.append(self)

    monkeypatch.setattr(device.ctypes, "CDLL", Driver)
    monkeypatch.setattr(device.threading, "Thread", Thread)
    monkeypatch.setenv("JAX_PLATFORMS", platforms or "")
    device.wake_driver()
    for thread in threads:
        thread.join()
    assert calls == (["libcuda.so.1", 0] if opened else [])


def test_a_machine_without_a_driver_says_nothing(monkeypatch, capfd):
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    before = set(threading.enumerate())
    device.wake_driver()
    for thread in set(threading.enumerate()) - before:
        thread.join()
    assert capfd.readouterr() == ("", "")
