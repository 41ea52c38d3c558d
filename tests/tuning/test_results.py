"""The results of a search: tables with values as YAML writes them, success or return."""

import re
import statistics

import pytest

from helpers import point_mass
from jetbot_mjx.config import load_config
from jetbot_mjx.tuning.results import entrants_table, run_search
from jetbot_mjx.tuning.search import Entrant, Search
from jetbot_mjx.tuning.space import read_space
from jetbot_mjx.tuning.trials import Trials


def test_values_in_the_table_can_be_copied_into_a_configuration():
    values = {
        "ppo.desired_kl": None,
        "ppo.normalize_observations": True,
        "ppo.network.value_hidden_layer_sizes": (64, 64),
        "ppo.learning_rate": 0.00123456,
        "ppo.activation": "tanh",
    }
    row = entrants_table(
        [Entrant("as given", values, (0.5,), (0.5,), (0.5,), (1.0,))]
    ).splitlines()[-1]
    assert row.endswith(
        " | desired_kl null, normalize_observations true, value_hidden_layer_sizes [64, 64],"
        " learning_rate 0.001235, activation tanh |"
    )


@pytest.mark.slow
def test_a_search_in_an_environment_maximises_the_return(tmp_path):
    config = point_mass.config()
    space = read_space({"ppo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}, config)
    said = []
    folder = tmp_path / "found"
    found = run_search(config, space, folder, trials=2, round_size=2, confirm=1, say=said.append)
    assert said[0].startswith(f"results: {folder}, where the same command with --output ")
    # Every reward is at most 1, and an episode has 16.
    assert re.match(r"2 of 2 trials, best mean return 1\d\.\d\d; this round of 2 took", said[1])
    best = found.best
    assert (best.scored_by, best.mean_seconds) == ("return", (None,) * 5)
    assert all(10 < score <= 16 for score in best.scores)
    assert f"return={statistics.fmean(best.scores):.2f}" in repr(found)
    tables = (folder / "trials.md").read_text().splitlines()
    assert tables[0].startswith("| | mean return while learning | return | worst seed | mean time")
    assert "| trial | mean return | last return | mean time [s] | ppo.learning_rate |" in tables
    assert (folder / "trials.csv").read_text().startswith("trial,state,score,episode_return,")
    assert load_config(folder / "best.yaml").environment == config.environment


@pytest.mark.slow
def test_a_search_that_is_stopped_in_its_final_trainings_has_results(tmp_path, monkeypatch):
    def stop(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(Search, "confirm", stop)
    config, said = point_mass.config(), []
    space = read_space({"ppo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}, config)
    with pytest.raises(KeyboardInterrupt):
        run_search(config, space, tmp_path, trials=2, round_size=2, confirm=1, say=said.append)
    assert load_config(tmp_path / "best.yaml").environment == config.environment
    assert (tmp_path / "trials.md").read_text().startswith("| trial |")
    assert said[-1].startswith(f"{tmp_path / 'best.yaml'} is the best trial so far; what follows")


@pytest.mark.slow
def test_where_an_environment_tells_successes_they_are_the_score():
    config = point_mass.config(environment_options={"succeeds": True})
    (outcome,) = Trials(config, (), evaluations=2).run([{}], [0])
    assert outcome.scored_by == "success"
    assert all(0 <= score <= 1 for score in outcome.scores)
