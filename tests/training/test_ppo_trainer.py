"""The trainer between two calls of its programs."""

import types

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.types import UInt64

from jetbot_mjx.agents import LOSSES, TALLIED, NanDump
from jetbot_mjx.config import parse_config
from jetbot_mjx.packed import pack
from jetbot_mjx.training.callbacks import TrainerCallback
from jetbot_mjx.training.ppo_trainer import CompiledTrainer, _metrics, _train_loop


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


def logged(training_steps, skipped, losses):
    """The metrics of some training steps with 16 updates each, whose losses add up to these."""
    ppo = parse_config({"ppo": {"num_minibatches": 4, "num_updates_per_batch": 4}}).ppo
    sums = dict.fromkeys(TALLIED, 0.0) | dict.fromkeys(LOSSES.values(), losses)
    sums |= {"training_steps": training_steps, "nonfinite_updates": skipped}
    return _metrics(sums, types.SimpleNamespace(config=ppo, has_success=True))


def test_a_skipped_update_is_no_part_of_a_mean():
    # One update of the second training step is applied, and then none of a third one.
    for training_steps, skipped in ((2, 15), (3, 31)):
        metrics = logged(training_steps, skipped, losses=17 * 0.5)
        assert [metrics[name] for name in LOSSES.values()] == [0.5] * len(LOSSES)
        assert metrics["train/nonfinite_updates"] == skipped


def test_where_no_update_was_applied_there_is_no_loss():
    metrics = logged(2, 32, losses=0.0)
    assert not {*LOSSES.values(), "policy/entropy"} & metrics.keys()
    assert metrics["train/nonfinite_updates"] == 32
    assert logged(0, 0, losses=0.0) == {}


def test_a_call_stores_one_dump_of_each_seed_whatever_devices_found_one():
    ppo = parse_config({"ppo": {"num_timesteps": 1}}).ppo
    # Device 1 found one of seed 1, and device 2 of both.
    found = np.array([[False, False], [False, True], [True, True]])
    marks = np.arange(6, dtype=np.float32).reshape(3, 2)
    dumps = NanDump(found, pack({"mark": marks}, batch_axes=2), marks, np.zeros((3, 2), np.int32))
    told = []

    class Recorder(TrainerCallback):
        def on_nan_dump(self, seed_index, env_steps, nan_dump):
            told.append((seed_index, env_steps, float(nan_dump.env_state["mark"])))

    trainer = types.SimpleNamespace(ppo=types.SimpleNamespace(config=ppo), get=lambda state: [])
    stop = types.SimpleNamespace(requested=False, notice=30.0)
    advance = lambda state, steps, restart: (state, dumps)  # noqa: E731
    _train_loop(trainer, advance, Recorder(), stop, 1, None, 0)
    size = ppo.steps_per_training_step
    assert told == [(0, size, 4.0), (1, size, 3.0)]
