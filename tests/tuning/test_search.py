"""A study goes on where it was stopped, shares its work, and loses nothing."""

from typing import ClassVar

import optuna
import pytest

from jetbot_mjx.config import parse_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.tuning import results, search
from jetbot_mjx.tuning.space import Parameter
from jetbot_mjx.tuning.trials import Outcome

CONFIG = parse_config({"ppo": {"learning_rate": 1e-3}})
SPACE = [
    Parameter("ppo.learning_rate", 1e-4, 1e-2, log=True),
    Parameter("ppo.unroll_length", choices=(8, 16)),
]
WAITING, COMPLETE, RUNNING, FAIL = (
    getattr(optuna.trial.TrialState, name) for name in ("WAITING", "COMPLETE", "RUNNING", "FAIL")
)


class Quick:
    """Stands for `Trials`: scores a learning rate by its distance to 3e-3, and notes its calls."""

    calls: ClassVar[list] = []

    def __init__(self, config, names, evaluations):
        self.config, self.names = config, names

    def run(self, values, seeds):
        self.calls.append((self.config.ppo.unroll_length, len(values), tuple(seeds)))
        return [
            Outcome((0.5, 1 - abs(one["ppo.learning_rate"] - 3e-3) * 10), 1.0, {"w": seed})
            for one, seed in zip(values, seeds, strict=True)
        ]

    def evaluate(self, params, keys):
        class Seen:
            success = [[1.0, 0.0]] * len(params["w"])
            steps = [[60.0, 10.0]] * len(params["w"])

        return Seen


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    Quick.calls = []
    monkeypatch.setattr(search, "Trials", Quick)


def test_rounds_of_trials_until_there_are_enough(tmp_path):
    said = []
    one = search.Search(CONFIG, SPACE, tmp_path / "s", say=said.append)
    one.run(10, round_size=4)
    assert [trial.state for trial in one.study.trials] == [COMPLETE] * 10
    # 4 + 4 + 2, each grouped by unroll length.
    assert sum(count for _, count, _ in Quick.calls) == 10
    assert {length for length, _, _ in Quick.calls} == {8, 16}
    assert len(said) == 3
    assert "10 of 10 trials" in said[-1]
    # The first trial is the configuration as it was given.
    assert one.study.trials[0].params == {"ppo.learning_rate": 1e-3, "ppo.unroll_length": 16}
    # Each trial has a seed of its own.
    assert len({seed for _, _, seeds in Quick.calls for seed in seeds}) == 10


def test_a_study_goes_on(tmp_path):
    search.Search(CONFIG, SPACE, tmp_path / "s").run(4, 4)
    again = search.Search(CONFIG, SPACE, tmp_path / "s")
    again.run(6, 4)
    assert len(again.study.trials) == 6
    again.run(6, 4)
    assert len(again.study.trials) == 6


def test_another_space_or_configuration_is_refused(tmp_path):
    search.Search(CONFIG, SPACE, tmp_path / "s")
    with pytest.raises(UserError, match="with another space: choose a new --output"):
        search.Search(CONFIG, SPACE[:1], tmp_path / "s")
    other = parse_config({"seed": 7})
    with pytest.raises(UserError, match="with another config: choose a new --output"):
        search.Search(other, SPACE, tmp_path / "s")


def test_the_trials_of_a_dead_worker_are_run_again(tmp_path, monkeypatch):
    monkeypatch.setattr(search, "_STALE_SECONDS", 1)
    monkeypatch.setattr(search, "_BEAT_SECONDS", 1)
    dead = search.Search(CONFIG, SPACE, tmp_path / "s")
    # It asks, beats once, and is gone.
    with search._quiet():
        trials = [dead.study.ask() for _ in range(2)]
    values = []
    for trial in trials:
        values.append({one.name: one.suggest(trial) for one in SPACE})
        dead._storage.record_heartbeat(trial._trial_id)
    next_one = search.Search(CONFIG, SPACE, tmp_path / "s")
    next_one.run(3, 4)
    states = [trial.state for trial in next_one.study.trials]
    assert states.count(FAIL) == 2
    assert states.count(COMPLETE) == 3
    done = [trial.params for trial in next_one.study.trials if trial.state == COMPLETE]
    assert all(one in done for one in values)


def test_values_that_do_not_fit_together_fail_with_their_reason(tmp_path):
    space = [Parameter("ppo.batch_size", choices=(24,)), SPACE[0]]
    one = search.Search(CONFIG, space, tmp_path / "s")
    with search._quiet():
        one._train([one.study.ask()])
    (stored,) = one.study.trials
    assert stored.state == FAIL
    assert "is not a multiple of num_envs" in stored.user_attrs["error"]


def test_a_search_in_which_nothing_fits_ends(tmp_path):
    space = [Parameter("ppo.batch_size", choices=(24,))]
    with pytest.raises(UserError, match="none of the last 4 trials could be trained"):
        search.Search(CONFIG, space, tmp_path / "s").run(4, 4)


def test_a_storage_that_cannot_be_used_is_named(tmp_path):
    with pytest.raises(UserError, match="--storage nonsense cannot be used"):
        search.Search(CONFIG, SPACE, tmp_path / "s", storage="nonsense")


def test_results_are_written(tmp_path):
    folder = tmp_path / "s"
    one = search.Search(CONFIG, SPACE, folder)
    one.run(8, 4)
    entrants = one.confirm(2, seeds=3)
    assert [len(each.areas) for each in entrants] == [3, 3, 3]
    assert entrants[0].name == "as given"
    assert entrants[0].success_rates == (0.5,) * 3
    # A failed episode counts with its whole time: 60 and 256 steps of 1/60 s.
    assert entrants[0].mean_seconds[0] == pytest.approx((60 + 256) / 2 / 60)
    path = results.write_results(folder, CONFIG, one.study, entrants)
    best = results.best_entrant(entrants)
    from jetbot_mjx.config import load_config

    assert load_config(path).ppo.learning_rate == best.values["ppo.learning_rate"]
    assert len((folder / "trials.csv").read_text().splitlines()) == 9
    assert best.name in (folder / "trials.md").read_text()
    assert {path.stem for path in folder.glob("*.png")} == set(results._PLOTS)
