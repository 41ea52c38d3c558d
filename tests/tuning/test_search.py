"""A study resumes, shares its trials among workers, and loses none."""

import contextlib
import os
import sqlite3
import sys
import threading
from pathlib import Path

import optuna
import pytest
import sqlalchemy.exc

from helpers import point_mass
from helpers.own_robots import load_robot
from helpers.quick_trials import Quick
from helpers.stages import noted_stages
from jetbot_mjx.config import load_config, parse_config, robot_files
from jetbot_mjx.errors import UserError
from jetbot_mjx.terminal import progress
from jetbot_mjx.tuning import results, search
from jetbot_mjx.tuning.space import Parameter
from jetbot_mjx.tuning.trials import Outcome

CONFIG = parse_config({"ppo": {"learning_rate": 1e-3}})
SPACE = [
    Parameter("ppo.learning_rate", 1e-4, 1e-2, log=True),
    Parameter("ppo.unroll_length", choices=(8, 16)),
]
WAITING, COMPLETE, RUNNING, PRUNED, FAIL = (
    getattr(optuna.trial.TrialState, name)
    for name in ("WAITING", "COMPLETE", "RUNNING", "PRUNED", "FAIL")
)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    Quick.calls = []
    monkeypatch.setattr(search, "Trials", Quick)


def test_rounds_of_trials_until_there_are_enough(tmp_path):
    said = []
    one = search.Search(CONFIG, SPACE, tmp_path / "s", say=said.append)
    one.run(10, round_size=4)
    assert [trial.state for trial in one.study.trials] == [COMPLETE] * 10
    # Each round has one unroll length, and one program trains it.
    assert [count for _, count, _ in Quick.calls] == [4, 4, 2]
    assert len(said) == 3
    assert "10 of 10 trials" in said[-1]
    # The first trial is the configuration as it was given.
    assert one.study.trials[0].params == {"ppo.learning_rate": 1e-3, "ppo.unroll_length": 16}
    # Each trial has a seed of its own.
    assert len({seed for _, _, seeds in Quick.calls for seed in seeds}) == 10


def test_trials_that_will_not_be_among_the_best_end_early(tmp_path, monkeypatch):
    monkeypatch.setattr(search, "_STARTUP_TRIALS", 8)
    asked = []

    class Slow(Quick):
        def train(self, learning_rate, seed, goes_on):
            # From the second evaluation on; the mean so far falls with the rate.
            for n in (1, 2, 3):
                asked.append(n)
                so_far = Outcome((1 - learning_rate,) * n, 1.0, None)
                if not goes_on(so_far):
                    return so_far
            return so_far._replace(scores=(*so_far.scores, 1 - learning_rate), params={"w": seed})

    monkeypatch.setattr(search, "Trials", Slow)
    one = search.Search(CONFIG, SPACE, tmp_path / "s")
    one.run(8, 8)
    assert {trial.state for trial in one.study.trials} == {COMPLETE}
    assert asked == [1, 2, 3] * 8
    one.run(24, 8)
    pruned = [trial for trial in one.study.trials if trial.state == PRUNED]
    assert 0 < len(pruned) < 16
    assert len(one.study.trials) == 24
    assert {len(trial.intermediate_values) for trial in pruned} <= {2, 3}
    # Worse than the median of those that were trained to their end by then.
    rates = sorted(trial.params["ppo.learning_rate"] for trial in one.study.trials[:8])
    assert all(trial.params["ppo.learning_rate"] > rates[2] for trial in pruned)
    assert not {trial.number for trial in pruned} & {
        x.number for x in search.ranked_trials(one.study)
    }


@pytest.mark.parametrize("startup", [4, 16])
def test_every_program_is_tried_before_the_best_are_varied(tmp_path, monkeypatch, startup):
    monkeypatch.setattr(search, "_STARTUP_TRIALS", startup)
    space = [*SPACE, Parameter("ppo.num_updates_per_batch", choices=(2, 4))]
    one = search.Search(CONFIG, space, tmp_path / "s")
    one.run(64, 16)
    rounds = [one.study.trials[first : first + 16] for first in range(0, 64, 16)]
    names = ("ppo.unroll_length", "ppo.num_updates_per_batch")
    seen = [{tuple(trial.params[name] for name in names) for trial in each} for each in rounds]
    assert [len(programs) for programs in seen] == [1] * 4
    given = (CONFIG.ppo.unroll_length, CONFIG.ppo.num_updates_per_batch)
    assert seen[0] == {given}
    assert set.union(*seen) == {(8, 2), (8, 4), (16, 2), (16, 4)}


def test_the_shortest_time_among_those_that_reach_their_goals(tmp_path, monkeypatch):
    monkeypatch.setattr(Quick, "scored_as", "time")
    said = []
    one = search.Search(CONFIG, SPACE[:1], tmp_path / "s", objective="time", say=said.append)
    one.run(40, 8)
    rates = [trial.params["ppo.learning_rate"] for trial in search.ranked_trials(one.study)]
    best = min(rate for rate in rates if rate >= 7e-4)
    assert rates[0] == best
    # Behind them those that miss goals, although they are faster.
    assert min(rates) < 7e-4
    assert rates == sorted(rates, key=lambda rate: (rate < 7e-4, rate))
    assert f"best mean time {1 + best:.3f} s with 100.00% success" in said[-1]
    entrants = one.confirm(2, 2, 4)
    assert results.best_entrant(entrants).values["ppo.learning_rate"] == best
    table = results.entrants_table(entrants)
    assert "| | time when learnt | success [%] |" in table
    assert f"trial {search.ranked_trials(one.study)[0].number} (best) | {1 + best:.3f} s |" in table
    with pytest.raises(UserError, match="with another objective: choose a new --output"):
        search.Search(CONFIG, SPACE[:1], tmp_path / "s")


def test_an_environment_has_no_time_to_improve(tmp_path):
    with pytest.raises(UserError, match=r"^--objective time is for goals of robots, and environm"):
        search.Search(point_mass.config(), SPACE[:1], tmp_path / "s", objective="time")
    assert not (tmp_path / "s").exists()


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
    # A worker that asks for two trials, sends one heartbeat for each, and dies.
    with search.quiet():
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
    with search.quiet():
        trial = one.study.ask()
        one._train([trial], [{each.name: each.suggest(trial) for each in space}])
    (stored,) = one.study.trials
    assert search.finished_trials(one.study) == []
    assert "is not a multiple of num_envs" in stored.user_attrs["error"]


def test_a_search_in_which_nothing_fits_ends(tmp_path):
    space = [Parameter("ppo.batch_size", choices=(24,))]
    with pytest.raises(UserError, match="none of the last 32 trials could be trained"):
        search.Search(CONFIG, space, tmp_path / "s").run(4, 4)


def test_a_setting_may_be_null_in_the_configuration_or_among_the_choices(tmp_path):
    config = parse_config({"ppo": {"max_grad_norm": None}})
    clipped = Parameter("ppo.max_grad_norm", 0.3, 3.0)
    one = search.Search(config, [SPACE[0], clipped], tmp_path / "range")
    one.run(4, 4)
    # The program of the given configuration does not clip.
    assert one.confirm(1, 2, 4)[0].values == {}
    assert {length for _, length, _ in Quick.calls[-2:]} == {2}
    either = Parameter("ppo.max_grad_norm", choices=(None, 1.0))
    two = search.Search(config, [SPACE[0], either], tmp_path / "choices")
    two.run(8, 8)
    assert two.study.trials[0].params["ppo.max_grad_norm"] is None
    assert len(two.confirm(2, 2, 4)) == 3


@pytest.mark.slow
def test_choices_may_be_lists(tmp_path, monkeypatch):
    monkeypatch.setattr(search, "_STARTUP_TRIALS", 3)
    name = "ppo.network.policy_hidden_layer_sizes"
    config = parse_config({"ppo": {"network": {"policy_hidden_layer_sizes": [16]}}})
    space = [SPACE[0], Parameter(name, choices=((16,), (8, 8)))]
    one = search.Search(config, space, tmp_path / "s")
    one.run(6, 3)
    assert [trial.state for trial in one.study.trials] == [COMPLETE] * 6
    # Optuna stores them as text; the first one is the given configuration.
    assert one.study.trials[0].params[name] == "[16]"
    assert "[8, 8]" in {trial.params[name] for trial in one.study.trials}
    entrants = one.confirm(2, 2, 4)
    assert {entrant.values.get(name) for entrant in entrants} <= {None, (16,), (8, 8)}
    path = results.write_results(tmp_path, config, one, entrants)
    assert load_config(path).ppo.network.policy_hidden_layer_sizes in ((16,), (8, 8))


def test_the_largest_seed_can_be_searched(tmp_path):
    config = parse_config({"seed": 2**32 - 1})
    one = search.Search(config, SPACE, tmp_path / "s")
    one.run(4, 4)
    one.confirm(1, 2, 4)
    assert set(Quick.calls[-1][2]) <= {999_999, 1_000_000}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"init_from": "/nowhere"}, "no checkpoint at /nowhere: no such folder"),
        ({"seeds": 2}, "seeds = 2 cannot be tuned: leave it out"),
        (
            {
                "trainer": "brax",
                "ppo": {"normalizer": "brax", "learning_rate_schedule": "NONE"},
            },
            "trainer = 'brax' cannot be tuned: take trainer = 'resumable'",
        ),
    ],
)
def test_unsupported_settings_of_trials_are_refused_before_writing(tmp_path, changes, told):
    with pytest.raises(UserError, match=told):
        search.Search(parse_config(changes), SPACE, tmp_path / "s")
    assert list(tmp_path.iterdir()) == []


def test_the_trials_of_a_worker_that_hangs_are_run_by_another(tmp_path, monkeypatch):
    for name, seconds in (("_STALE_SECONDS", 1), ("_BEAT_SECONDS", 1), ("_PATIENCE_SECONDS", 1.5)):
        monkeypatch.setattr(search, name, seconds)
    hanging, other = (search.Search(CONFIG, SPACE, tmp_path / "s") for _ in range(2))
    released, asked = threading.Event(), threading.Event()

    def hang(batch, drawn, seeds, goes_on):
        asked.set()
        assert released.wait(60)
        return batch.run([{"ppo.learning_rate": 1e-3}] * len(drawn), seeds)

    monkeypatch.setattr(hanging, "_outcomes", hang)
    thread = threading.Thread(target=lambda: hanging.run(2, 2))
    thread.start()
    assert asked.wait(60)
    other.run(2, 2)
    states = [trial.state for trial in other.study.trials]
    released.set()
    thread.join()
    assert sorted(states) == sorted([FAIL, FAIL, COMPLETE, COMPLETE])
    # What the first one finds in the end changes nothing.
    assert [trial.state for trial in other.study.trials] == states


def test_a_trial_killed_before_its_first_heartbeat_is_run_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(search, "_STALE_SECONDS", 1)
    monkeypatch.setattr(search, "_POLL_SECONDS", 0.2)
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_LINE", 0.0)
    with search.quiet():
        search.Search(CONFIG, SPACE, tmp_path / "s").study.ask()
    again = search.Search(CONFIG, SPACE, tmp_path / "s")
    with progress.show_progress(sys.stderr):
        again.run(1, 1)
    assert [trial.state for trial in again.study.trials] == [FAIL, COMPLETE]
    assert "waiting for trials of other workers" in capsys.readouterr().err


def test_an_interrupted_round_is_run_again_at_once(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Quick, "run", interrupted)
        with pytest.raises(KeyboardInterrupt):
            search.Search(CONFIG, SPACE, tmp_path / "s").run(3, 3)
    again = search.Search(CONFIG, SPACE, tmp_path / "s")
    waiting = [trial.params for trial in again.study.trials if trial.state == WAITING]
    assert len(waiting) == 3
    again.run(3, 3)
    states = [trial.state for trial in again.study.trials]
    assert (states.count(FAIL), states.count(COMPLETE)) == (3, 3)
    assert [trial.params for trial in again.study.trials if trial.state == COMPLETE] == waiting


def interrupted(self, values, seeds, goes_on):
    raise KeyboardInterrupt


def test_a_trial_that_another_worker_took_for_dead_is_left_to_it(tmp_path, monkeypatch):
    one = search.Search(CONFIG, SPACE, tmp_path / "s")
    run = Quick.run

    def slow(self, values, seeds, goes_on):
        monkeypatch.setattr(Quick, "run", run)
        other = search.Search(CONFIG, SPACE, tmp_path / "s")
        other.study.tell(0, state=FAIL)
        return run(self, values, seeds, goes_on)

    monkeypatch.setattr(Quick, "run", slow)
    one.run(2, 2)
    assert [trial.state for trial in one.study.trials].count(COMPLETE) == 2


def test_values_that_a_network_refuses_fail_with_their_reason(tmp_path, monkeypatch):
    def refuse(self, config, names, evaluations):
        if config.ppo.unroll_length == 8:
            raise UserError("eight is too short")
        self.config, self.names = config, names

    monkeypatch.setattr(Quick, "__init__", refuse)
    monkeypatch.setattr(search, "_STARTUP_TRIALS", 4)
    said = []
    one = search.Search(CONFIG, SPACE, tmp_path / "s", say=said.append)
    one.run(16, 4)
    assert len(search.completed_trials(one.study)) == 16
    assert {trial.params["ppo.unroll_length"] for trial in one.study.trials} == {8, 16}
    # A round of which nothing can be trained is told, and the next one draws other values.
    told = [line for line in said if "4 could not be trained, such as: eight is too short" in line]
    assert len(told) == len(said) - 4 > 0


def test_too_many_trials_for_the_memory_are_told(tmp_path, monkeypatch):
    def run(self, values, seeds, goes_on):
        raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    monkeypatch.setattr(Quick, "run", run)
    with pytest.raises(UserError, match="trials at once: choose a smaller --round"):
        search.Search(CONFIG, SPACE[:1], tmp_path / "s").run(4, 4)


def test_workers_that_begin_at_once_draw_other_values(tmp_path):
    one, two = (search.Search(CONFIG, SPACE[:1], tmp_path / "s") for _ in range(2))
    one.run(4, 4)
    two.run(8, 4)
    drawn = [trial.params["ppo.learning_rate"] for trial in two.study.trials]
    assert len(set(drawn)) == 8


def test_a_worker_waits_for_the_tables_that_another_creates(tmp_path, monkeypatch):
    calls = []

    class Racing(optuna.storages.RDBStorage):
        def __init__(self, *arguments, **options):
            calls.append(arguments)
            if len(calls) == 1:
                raise sqlalchemy.exc.IntegrityError("INSERT", {}, Exception("UNIQUE constraint"))
            super().__init__(*arguments, **options)

    monkeypatch.setattr(optuna.storages, "RDBStorage", Racing)
    search.Search(CONFIG, SPACE, tmp_path / "s")
    assert len(calls) == 2


@pytest.mark.parametrize("name", ["a b", "50%20?#", "{x}"])
def test_any_folder_can_hold_a_study(tmp_path, monkeypatch, name):
    (folder := tmp_path / name).mkdir()
    monkeypatch.chdir(folder)
    one = search.Search(CONFIG, SPACE, Path())
    assert one.study.study_name == name
    assert [path.name for path in folder.iterdir()] == ["study.db"]
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.slow
def test_without_final_trainings_the_best_trial_is_the_best(tmp_path):
    one = search.Search(CONFIG, SPACE[:1], tmp_path / "s")
    one.run(8, 4)
    assert one.confirm(0, 5, 4) == []
    path = results.write_results(tmp_path, CONFIG, one, [])
    best = one.study.best_trial.params["ppo.learning_rate"]
    assert load_config(path).ppo.learning_rate == best
    table = (tmp_path / "trials.md").read_text()
    assert table.startswith("| trial |")
    assert table.count("\n| 0 (as given) |") == table.count("as given") == 1


def test_the_best_configuration_has_its_robots_model_beside_it(tmp_path, monkeypatch):
    config = load_robot("car")
    one = search.Search(config, SPACE[:1], tmp_path / "s")
    one.run(2, 2)
    path = results.write_results(tmp_path, config, one, [])
    monkeypatch.setattr(robot_files, "_MODELS", {})  # as in another process
    assert load_config(path).robot == config.robot
    assert robot_files.model_files(config.robot.sha256)


def test_a_storage_that_cannot_be_used_is_named(tmp_path):
    with pytest.raises(UserError, match="--storage nonsense cannot be used"):
        search.Search(CONFIG, SPACE, tmp_path / "s", storage="nonsense")


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE study_user_attributes SET value_json = 'smoke'",
        "UPDATE trials SET state = 'FINISHED'",
        "UPDATE trials SET datetime_start = 'yesterday'",
        "UPDATE trial_params SET distribution_json = '{}'",
        "DELETE FROM trial_params",
        "UPDATE study_directions SET direction = 'ONWARDS'",
    ],
)
def test_a_damaged_study_is_refused_before_a_training(tmp_path, damage):
    search.Search(CONFIG, SPACE, tmp_path / "s").run(2, 2)
    with contextlib.closing(sqlite3.connect(tmp_path / "s" / "study.db")) as database:
        database.execute(damage)
        database.commit()
    Quick.calls = []
    with pytest.raises(UserError, match=r"--storage sqlite:.*study\.db cannot be used: ") as caught:
        search.Search(CONFIG, SPACE, tmp_path / "s").run(3, 1)
    assert "\n" not in str(caught.value)
    assert Quick.calls == []


def test_no_connection_to_the_study_stays_open(tmp_path):
    one = search.Search(CONFIG, SPACE, tmp_path / "s")
    one.run(2, 2)
    assert len(one.study.trials) == 2
    opened = [os.path.realpath(path) for path in Path("/proc/self/fd").iterdir()]
    assert str(tmp_path / "s" / "study.db") not in opened


@pytest.mark.slow
def test_every_phase_is_a_stage_that_a_command_shows(tmp_path):
    with noted_stages() as shown:
        one = search.Search(CONFIG, SPACE, tmp_path / "s")
        assert shown == ["opening the study"]
        one.run(2, 2)
        phases = ["drawing values", "preparing the environment and the networks", "storing trials"]
        assert {"trials", *phases} == {*shown[1:]}
        shown.clear()
        entrants = one.confirm(1, 1, 2)
        assert shown[0] == "final trainings"
        assert "2,048 episodes of the report's goals" in shown
        shown.clear()
        results.write_results(tmp_path / "s", CONFIG, one, entrants)
        assert shown == ["plots"]


@pytest.mark.slow
def test_results_are_written(tmp_path):
    folder = tmp_path / "s"
    one = search.Search(CONFIG, SPACE, folder)
    one.run(8, 4)
    entrants = one.confirm(2, 3, 4)
    assert [len(each.objectives) for each in entrants] == [3, 3, 3]
    assert entrants[0].name == "as given"
    # The given configuration, which was the first trial, is not retrained twice.
    assert "trial 0" not in {each.name for each in entrants}
    assert entrants[0].scores == (0.5,) * 3
    # A failed episode counts with its whole time: 60 and 256 steps of 1/60 s.
    assert entrants[0].mean_seconds[0] == pytest.approx((60 + 256) / 2 / 60)
    path = results.write_results(folder, CONFIG, one, entrants)
    best = results.best_entrant(entrants)
    assert load_config(path).ppo.learning_rate == best.values["ppo.learning_rate"]
    assert len((folder / "trials.csv").read_text().splitlines()) == 9
    assert best.name in (folder / "trials.md").read_text()
    assert {path.stem for path in folder.glob("*.png")} == set(results._PLOTS)
