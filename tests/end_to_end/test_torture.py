"""A training that is killed several times ends as one that was never killed."""

import random
from types import SimpleNamespace

import pytest

from benchmarks.reliability import torture
from benchmarks.reliability.torture import SETTINGS, Aim
from helpers import gliding
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps

# A robot that glides needs more steps for the kills to fall into.
LONGER = (*SETTINGS, "checkpoint_interval=8_192", "ppo.num_timesteps=131_072")
TRAINER = gliding.program("train")


@pytest.fixture(scope="module")
def template():
    return torture.make_template(LONGER)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return torture.finish(tmp_path_factory.mktemp("torture") / "undisturbed", LONGER, TRAINER)


@pytest.mark.slow
def test_a_training_killed_again_and_again_ends_as_if_it_had_never_been(
    template, undisturbed, tmp_path
):
    rng = random.Random(4)
    aims = [
        Aim("started", rng.uniform(0.2, 2.5)),
        Aim("saving", rng.uniform(0.0, 0.03), 2),
        Aim("saved", rng.uniform(0.0, 0.5)),
    ]
    run = tmp_path / "run"
    phases = [torture.kill(run, LONGER, aim, template, TRAINER).phase for aim in aims]
    assert {torture.BEFORE_FIRST, torture.SAVING} <= set(phases), phases
    assert checkpoint_steps(run)[-1] > 0, "the last start must be from the middle"
    killed = torture.finish(run, LONGER, TRAINER)
    assert torture.differences(undisturbed, killed) == []
    assert checkpoint_steps(run) == [line["env_steps"] for line in killed.metrics]
    for steps in checkpoint_steps(run):
        torture.check_checkpoint(run, steps, template)


@pytest.mark.parametrize(
    "said",
    [
        "run folder: run",
        "resuming after 4,096 steps\nrun folder: run",
        "skipped: checkpoint 8192\nresuming after 8,192 steps\nrun folder: run",
        "Traceback (most recent call last):",
    ],
)
def test_a_start_from_elsewhere_is_seen(said):
    with pytest.raises(torture.RecoveryError):
        torture.check_start(SimpleNamespace(stdout=said, stderr=""), [0, 8_192])


@pytest.mark.slow
def test_a_difference_at_the_end_is_reported(undisturbed):
    assert set(undisturbed.digests) == {"policy", "training"}
    for name in torture.Outcome._fields:
        assert torture.differences(undisturbed, undisturbed._replace(**{name: []})) == [name]


@pytest.mark.slow
def test_fifty_kills_in_all_phases_change_nothing():
    assert torture.main(["--kills", "50"]) == 0
