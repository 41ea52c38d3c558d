"""Time steps that do not fit together are refused with a suggestion."""

import re

import pytest

from jetbot_mjx.config import load_config


@pytest.mark.parametrize(
    ("ctrl_dt", "sim_dt", "n_substeps"),
    # Rounded ratios: 0.02 / 0.006 = 3.3; 0.05 / 0.0021 = 23.8; never less than one.
    [(0.02, 0.006, 3), (0.05, 0.0021, 24), (0.02, 0.03, 1), (0.02, 7.0, 1)],
)
def test_the_suggested_sim_dt_works(refusal, write, ctrl_dt, sim_dt, n_substeps):
    message = refusal(f"physics: {{ctrl_dt: {ctrl_dt}, sim_dt: {sim_dt}}}")
    assert f"sim_dt = {sim_dt:g} goes" in message
    assert f"ctrl_dt = {ctrl_dt:g}" in message
    fit = re.search(r"sim_dt = (\S+)$", message)[1]
    config = load_config(write(f"physics: {{ctrl_dt: {ctrl_dt}, sim_dt: {fit}}}"))
    assert config.physics.n_substeps == n_substeps


@pytest.mark.parametrize(
    ("ctrl_dt", "sim_dt", "n_substeps"),
    [("0.016667", "0.0083333", 2), ("0.01666667", "0.00333333", 5), ("0.02", "0.02", 1)],
)
def test_rounded_time_steps_are_whole_enough(write, ctrl_dt, sim_dt, n_substeps):
    config = load_config(write(f"physics: {{ctrl_dt: {ctrl_dt}, sim_dt: {sim_dt}}}"))
    assert config.physics.n_substeps == n_substeps
