"""The trainer between two calls of its programs."""

import types

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.types import UInt64

from jetbot_mjx.training.ppo_trainer import CompiledTrainer


def test_to_take_the_seeds_apart_compiles_nothing():
    trainer = object.__new__(CompiledTrainer)
    trainer._seeds = np.arange(2)
    trainer.ppo = types.SimpleNamespace(unpacked=lambda state: state)
    state = {"steps": UInt64(hi=jnp.zeros(2, jnp.uint32), lo=jnp.array([5, 7], jnp.uint32))}
    # Brax's counter itself converts a number.
    UInt64(hi=np.uint32(0), lo=np.uint32(1))
    events = []

    def listen(event, duration, **kwargs):
        events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        each = trainer.get(state)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert [int(one["steps"]) for one in each] == [5, 7]
    assert not [event for event in events if "backend_compile" in event]
