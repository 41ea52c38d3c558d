"""Batch sizes that do not fit together are refused with a suggestion."""

import re

import pytest

from jetbot_mjx.config import load_config


@pytest.mark.parametrize(
    ("num_envs", "batch_size", "num_minibatches"),
    [(512, 100, 4), (12, 7, 3), (4096, 128, 4), (7, 1, 1), (6, 100, 4), (1000, 64, 7)],
)
def test_the_suggested_batch_size_works(refusal, write, num_envs, batch_size, num_minibatches):
    text = f"checkpoint_interval: 10_000_000\nppo: {{num_envs: {num_envs}}}"
    minibatches = f"ppo.num_minibatches={num_minibatches}"
    message = refusal(text, minibatches, f"ppo.batch_size={batch_size}")
    product = batch_size * num_minibatches
    assert f"num_minibatches = {product} is not a multiple of num_envs = {num_envs}" in message
    fit = re.search(r"batch_size = (\d+)$", message)[1]
    config = load_config(write(text), [minibatches, f"ppo.batch_size={fit}"])
    assert config.ppo.batch_size == int(fit)


def test_a_schedule_that_cannot_be_counted_is_refused(refusal, write):
    text = "ppo: {learning_rate_schedule: LINEAR}"
    message = refusal(text, "ppo.num_timesteps=1e15")
    assert "learning_rate_schedule = 'LINEAR' counts 2,147,483,647: train for at most" in message
    most = int(re.search(r"at most (\d+) steps", message)[1])
    assert load_config(write(text), [f"ppo.num_timesteps={most}"]).ppo.gradient_steps < 2**31
    refusal(text, f"ppo.num_timesteps={most + 1}")
    load_config(write("ppo: {learning_rate_schedule: NONE}"), ["ppo.num_timesteps=1e15"])
