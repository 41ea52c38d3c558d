"""What grows in a long training is told from noise; counters stay exact however long it is."""

import json
import shutil

import jax
import numpy as np
import pytest

from benchmarks.reliability import soak
from helpers.tensorboard_files import read_events
from jetbot_mjx.agents import UInt64
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup, read_history, resume, to_trees
from jetbot_mjx.runs.checkpoint_store import (
    CheckpointStore,
    checkpoint_path,
    checkpoint_steps,
    read_about,
)
from jetbot_mjx.runs.metrics import METRICS
from jetbot_mjx.training import session
from jetbot_mjx.training.ppo_trainer import CompiledTrainer

RNG = np.random.default_rng(0)
NOISE = RNG.normal(0.0, 1e6, 200)
GROWING = np.arange(200.0)


@pytest.mark.parametrize(
    ("quantity", "values", "drifts"),
    [
        ("memory", 1e9 + NOISE, False),
        ("memory", 1e9 + NOISE + 200_000 * GROWING, True),
        ("files", np.full(200, 31.0), False),
        ("files", 31 + GROWING // 20, True),
        ("threads", [*range(50), *[50] * 150], False),  # they start in the warm-up
        ("threads", [70] * 120 + [71] * 80, False),  # up and down by one
        ("threads", [50 + x // 60 for x in range(200)], True),
        ("rate", 1e6 * (1 - 0.001 * GROWING), True),
        ("rate", 1e6 * (1 + 0.001 * GROWING), False),
        ("memory", 1e9 + NOISE - 200_000 * GROWING, False),
        ("work", 40 * (1 + 0.001 * GROWING), True),
        ("rate", 1e6 * (1 - 0.00001 * GROWING), False),  # certain, and too little to matter
        ("device_memory", np.zeros(200), False),
    ],
)
def test_a_drift_is_told_from_noise(quantity, values, drifts):
    found = soak.fit(quantity, list(values))
    assert found.drifts is drifts, found


def test_a_slope_has_its_error():
    found = soak.fit("files", list(0.5 * GROWING + RNG.normal(0.0, 2.0, 200)))
    assert found.slope == pytest.approx(0.5, abs=4 * found.error)
    # Of 150 points with a deviation of 2: 2 / sqrt(150 (150² - 1) / 12).
    assert found.error == pytest.approx(0.0038, rel=0.2)
    with pytest.raises(UserError, match="6 intervals are too few"):
        soak.fit("files", [1.0] * 6)


def begin_from(run, config, start):
    """Give a run a checkpoint after so many steps, with the state of its last one."""
    setup = Setup(config)
    resumed = resume([run], [config], CompiledTrainer.from_setup(setup).template())
    last = checkpoint_path(run, resumed.env_steps)
    counter = UInt64(hi=np.uint32(start >> 32), lo=np.uint32(start % 2**32))
    state = resumed.states[0]
    state = state.replace(env_steps=counter, normalizer=state.normalizer.replace(count=counter))
    about = {key: x for key, x in read_about(last).items() if key not in ("sha256", "joined")}
    about["progress"] = {**about["progress"], "env_steps": start, "best_steps": start}
    with CheckpointStore(run, keep=5) as store:
        store.save(start, jax.device_get(to_trees(state)), about, 0.5, ["training"])


@pytest.mark.slow
@pytest.mark.parametrize("end", [2**32 + 16_384, 2**53])
def test_counters_stay_exact(smoke_run, tmp_path, root, end):
    interval, run = 16_384, tmp_path / "run"
    shutil.copytree(smoke_run, run)
    start = end - 2 * interval
    settings = [f"ppo.num_timesteps={end - 1}", "evaluation.episodes=64"]
    config = load_config(root / "configs" / "smoke.yaml", settings)
    begin_from(run, config, start)
    session.run(config, run)
    steps = [start, start + interval, end]
    assert checkpoint_steps(run)[-3:] == steps
    assert [one.env_steps for one in read_history(run / METRICS)][-2:] == steps[1:]
    assert {step for step, *_ in read_events(run / "tensorboard")} >= {*steps[1:]}
    resumed = resume([run], [config], CompiledTrainer.from_setup(Setup(config)).template())
    assert (resumed.env_steps, resumed.skipped) == (end, [])
    state = resumed.states[0]
    counters = [int(x.to_numpy()) for x in (state.env_steps, state.normalizer.count)]
    assert counters == [end, end]


@pytest.mark.slow
def test_a_training_is_watched_killed_and_told(tmp_path, capsys):
    settings = ["evaluation.episodes=16", "checkpoint_interval=4_096", "ppo.num_timesteps=65_536"]
    arguments = [f"--set={one}" for one in settings]
    output = tmp_path / "soak.json"
    soak.main([*arguments, "--kills", "6", "--jobs", "2", "--output", str(output)])
    out = capsys.readouterr().out
    assert "16 intervals, 65,536 steps" in out
    assert "killed 5 times, terminated 1 times, " in out
    values = json.loads(output.read_text())
    assert [one["quantity"] for one in values["slopes"]] == [*soak.QUANTITIES]
    assert values["kills"]["ended"] >= 2
    assert 0 < values["kills"]["resumed"] <= 6
    first = values["samples"][0]
    assert min(x for key, x in first.items() if key != "device_memory") > 0
    assert output.with_suffix(".png").read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_a_training_that_ends_otherwise_is_found_out(tmp_path, monkeypatch, root):
    outcomes = iter(["one", "other"])
    monkeypatch.setattr(soak, "finish", lambda *_, **__: next(outcomes))
    file = root / "configs" / "smoke.yaml"
    # The process is killed at once, before it makes its run folder.
    (tmp_path / "killed-0").mkdir()
    with pytest.raises(soak.RecoveryError, match="ended otherwise"):
        soak.kill_often(file, [], tmp_path, 1)
