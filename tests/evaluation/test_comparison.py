"""Comparisons of runs, from episodes made by hand."""

import json

import numpy as np
import pytest
import scipy.stats

from helpers.reports import TEN_GOALS, comparison_of, make_episodes, make_report, report_of, wins
from jetbot_mjx.config import parse_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.comparison import check_comparable
from jetbot_mjx.evaluation.curves import CurvePoint
from jetbot_mjx.evaluation.evaluator import wilson_interval
from jetbot_mjx.evaluation.tables import (
    pairs_table,
    policies_table,
    runs_table,
    summarize_comparison,
)


def test_several_seeds_are_evaluated_over_seeds():
    seeds = [report_of(wins(count), 60 + 6 * count) for count in (2, 8, 9, 9, 10)]
    (run,) = comparison_of(a=seeds).runs
    assert (run.success_rate.over, run.success_rate.count) == ("seeds", 5)
    assert run.success_rate.mean.value == pytest.approx(0.76)
    assert run.success_rate.iqm.value == pytest.approx(26 / 30)
    assert 0.2 < run.success_rate.mean.low < 0.76 < run.success_rate.mean.high < 1.0
    assert run.time_to_goal.mean.value == pytest.approx((60 + 6 * 7.6) / 60)


def test_one_seed_is_evaluated_over_its_episodes():
    (run,) = comparison_of(a=[report_of(wins(9), np.arange(10) * 6)]).runs
    assert run.success_rate.over == run.time_to_goal.over == "episodes"
    assert run.success_rate.mean[1:] == wilson_interval(9, 10)
    assert run.time_to_goal.mean.value == pytest.approx(0.4)
    assert run.time_to_goal.mean.low < 0.4 < run.time_to_goal.mean.high


@pytest.mark.parametrize(("counts", "told"), [((1, 1), 0), ((5, 1), 0), ((4, 5), 1), ((2, 1), 1)])
def test_intervals_over_few_seeds_are_told_with_a_caveat(counts, told):
    seeds = [[report_of(wins(8))] * count for count in counts]
    said = summarize_comparison(comparison_of(**dict(zip("ab", seeds, strict=True))))
    assert said.count("over equal seeds they have no width\n") == told


def test_seeds_without_a_success_have_no_time_and_say_so():
    run = comparison_of(a=[report_of(wins(0)), report_of(wins(5))]).runs[0]
    assert (run.time_to_goal.count, run.time_to_goal.mean.value) == (1, pytest.approx(1.0))
    none = comparison_of(a=[report_of(wins(0)), report_of(wins(0))]).runs[0]
    assert none.time_to_goal.mean.value is None


def test_goals_are_won_and_lost_as_in_mcnemars_test():
    a = report_of([1, 1, 1, 1, 1, 1, 1, 0, 0, 0])
    b = report_of([1, 1, 0, 0, 0, 0, 0, 1, 0, 0])
    (pair,) = comparison_of(a=[a], b=[b]).pairs
    duel = pair.success_rate
    assert (duel.wins, duel.losses, duel.ties) == (5, 1, 4)
    assert duel.p == pytest.approx(scipy.stats.binomtest(5, 6).pvalue)
    assert duel.difference.value == pytest.approx(0.4)
    # Two policies, one of each: nothing is known of the next trainings.
    assert duel.difference.low is duel.improvement.value is None


def test_times_are_compared_on_goals_that_both_reached_and_less_is_better():
    a = report_of([1, 1, 1, 0, 1, 1, 1, 1, 1, 1], [30, 30, 60, 9, 60, 60, 60, 60, 60, 60])
    b = report_of([1, 1, 1, 1, 0, 1, 1, 1, 1, 1], [60, 60, 30, 9, 60, 60, 60, 60, 60, 60])
    duel = comparison_of(a=[a], b=[b]).pairs[0].time_to_goal
    assert (duel.wins, duel.losses, duel.ties) == (2, 1, 5)
    slow = [report_of(wins(10), steps) for steps in (90, 96)]
    fast = [report_of(wins(10), steps) for steps in (60, 66)]
    duel = comparison_of(slow=slow, fast=fast).pairs[0].time_to_goal
    assert duel.improvement.value == 0.0
    assert duel.difference.value == pytest.approx(0.5)
    assert (duel.wins, duel.losses) == (0, 10)


def test_equal_runs_are_even():
    seeds = [report_of(wins(8)), report_of(wins(9))]
    duel = comparison_of(a=seeds, b=seeds).pairs[0].success_rate
    assert (duel.wins, duel.losses, duel.ties, duel.p) == (0, 0, 10, 1.0)
    assert duel.improvement.value == 0.5


def test_more_seeds_of_one_run_do_not_weigh_goal_by_goal():
    # Every seed misses one goal, another each time: three of them together miss three.
    seeds = [report_of(np.arange(10) != missed) for missed in range(3)]
    pair = comparison_of(a=seeds, b=[report_of(np.arange(10) != 5)]).pairs[0]
    assert (pair.seeds, pair.success_rate.wins, pair.success_rate.losses) == (1, 1, 1)


@pytest.mark.parametrize(
    ("counts", "told"),
    [
        ((1, 1), "goals 0 : 0 (p 1)"),
        ((3, 3), "goals 0 : 0 (p 1)"),
        ((3, 1), "goals of the first seed of each 0 : 0 (p 1)"),
        ((2, 3), "goals of the first 2 seeds of each 0 : 0 (p 1)"),
    ],
)
def test_of_unequal_numbers_of_seeds_it_is_told_whose_goals_are_counted(counts, told):
    seeds = [[report_of(wins(8))] * count for count in counts]
    lines = pairs_table(comparison_of(**dict(zip("ab", seeds, strict=True)))).splitlines()
    assert len(lines) == 3
    assert all(line.endswith(f", {told}") for line in lines[1:])


def test_every_two_runs_meet():
    runs = {name: [report_of(wins(5))] for name in "abcd"}
    met = [(pair.a, pair.b) for pair in comparison_of(**runs).pairs]
    assert met == [(a, b) for a in "abcd" for b in "abcd" if a < b]


def test_a_curve_over_seeds_keeps_to_the_steps_they_share():
    def curve(*rates):
        return [CurvePoint(10 * i, rate, 0.0, 1.0, None) for i, rate in enumerate(rates)]

    seeds = [
        report_of(wins(5), curve=curve(0.0, 0.2, 0.9)),
        report_of(wins(5), curve=curve(0.0, 0.6)),
    ]
    (run,) = comparison_of(a=seeds).runs
    assert [point.env_steps for point in run.learning_curve] == [0, 10]
    assert run.learning_curve[1][1:4] == pytest.approx((0.4, 0.2, 0.6))
    (alone,) = comparison_of(a=seeds[:1]).runs
    assert alone.learning_curve[2] == (20, 0.9, 0.0, 1.0, None)
    (half,) = comparison_of(a=[seeds[0], report_of(wins(5))]).runs
    assert half.learning_curve == ()


def test_settings_that_differ_are_told():
    settings = {"task": {"observation": "egocentric"}, "seed": 3}
    runs = comparison_of(a=[report_of(wins(5))], b=[report_of(wins(5), settings=settings)])
    assert runs.differences == {"task.observation": ["world", "egocentric"]}


def test_a_step_may_cost_more_but_then_no_returns_are_told():
    settings = {"task": {"step_cost": 0.02}}
    check_comparable({"a": parse_config({}), "b": parse_config(settings)})
    alike = [report_of(wins(5)), report_of(wins(5))]
    assert "return" in policies_table(dict(zip("ab", alike, strict=True)))
    policies = {"a": report_of(wins(5)), "b": report_of(wins(5), settings=settings)}
    header, a, b = policies_table(policies).splitlines()[:3]
    assert "path" in header
    assert "return" not in header
    assert max(len(header), len(a), len(b)) < 70
    assert comparison_of(**{name: [one] for name, one in policies.items()}).differences == {
        "task.step_cost": [0.0, 0.02]
    }


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"task": {"episode_length": 128}}, "task.episode_length = 128, and not 256"),
        ({"task": {"success_radius": 0.2}}, "task.success_radius = 0.2, and not 0.1"),
        ({"task": {"options": {"width": 2}}}, "task.options.width = 2, and not None"),
        ({"robot": {"preset": "real"}}, "robot.preset = 'real', and not 'isaac'"),
        ({"physics": {"ctrl_dt": 1 / 30}}, "physics.ctrl_dt = 0.0333"),
    ],
)
def test_runs_that_had_something_else_to_do_are_refused(settings, said):
    with pytest.raises(UserError, match=r"b cannot be compared with a: ") as caught:
        check_comparable({"a": parse_config({}), "b": parse_config(settings)})
    assert said in str(caught.value)


def test_runs_that_drove_to_other_goals_are_refused():
    other = make_report(make_episodes(TEN_GOALS + 0.01, wins(5)))
    with pytest.raises(
        UserError, match="b cannot be compared with a: its task sampled other goals"
    ):
        comparison_of(a=[report_of(wins(5))], b=[other])


def test_runs_with_other_observations_and_trainings_are_comparable():
    other = {"task": {"observation": "egocentric"}, "ppo": {"learning_rate": 1e-4}, "seed": 5}
    network = {"ppo": {"network": {"policy_hidden_layer_sizes": [8]}}}
    check_comparable({"a": parse_config({}), "b": parse_config(other), "c": parse_config(network)})


def test_a_comparison_is_json_and_text():
    comparison = comparison_of(
        a=[report_of(wins(8)), report_of(wins(9))],
        b=[report_of(wins(0)), report_of(wins(0))],
        c=[report_of(wins(1))],
    )
    values = json.loads(json.dumps(comparison.to_json(), allow_nan=False))
    assert [run["name"] for run in values["runs"]] == ["a", "b", "c"]
    assert values["settings"]["robot.preset"] == "isaac"
    assert values["runs"][1]["time_to_goal"]["mean"]["value"] is None
    assert values["runs"][0]["seeds"][1]["policy"]["successes"] == 9
    assert values["pairs"][0]["success_rate"]["improvement"]["value"] == 1.0
    text = runs_table(comparison)
    assert "85.00% (80.00% .. 90.00%)" in text
    assert "2 seeds" in text
    assert "10 episodes" in text
    assert "a against b" in pairs_table(comparison)
    assert "intervals over few seeds are too narrow: over two" in summarize_comparison(comparison)
    assert "-" in policies_table({"b": comparison.runs[1].seeds["seed-0"]}).splitlines()[1]
