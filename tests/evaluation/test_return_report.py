"""What is reported about returns: learning curves, intervals over seeds, runs that fit together."""

from pathlib import Path

import numpy as np
import pytest

from helpers.reports import return_report_of
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.curves import ReturnPoint
from jetbot_mjx.evaluation.return_report import (
    check_one_environment,
    compare_code,
    compare_returns,
)
from jetbot_mjx.runs import TaskCode


def compared(**runs):
    return compare_returns(
        Path("somewhere"),
        {
            name: {f"seed-{i}": one for i, one in enumerate(reports)}
            for name, reports in runs.items()
        },
    )


def test_one_seed_is_evaluated_over_its_episodes():
    found = compared(a=[return_report_of([1.0, 2.0, 3.0])]).runs[0]
    assert (found.episode_return.over, found.episode_return.count) == ("episodes", 3)
    mean = found.episode_return.mean
    # Three returns of deviation 1: 2 ± 1.96 / √3.
    assert mean.value == 2.0
    assert (mean.low, mean.high) == pytest.approx((2 - 1.1316, 2 + 1.1316), abs=1e-3)
    assert found.success_rate is None


def test_several_seeds_are_evaluated_over_seeds_and_start_by_start():
    low = [return_report_of([x, x + 1.0, x + 0.5], "runs/a") for x in (1.0, 2.0)]
    high = [return_report_of([x, 0.0, x], "runs/b") for x in (5.0, 6.0, 90.0)]
    found = compared(a=low, b=high)
    a = found.runs[0].episode_return
    assert (a.over, a.count, a.mean.value, a.mean.low, a.mean.high) == ("seeds", 2, 2.0, 1.5, 2.5)
    (pair,) = found.pairs
    # Start by start only the seeds count that both runs have: a wins the second of three.
    assert (pair.seeds, pair.episode_return.wins, pair.episode_return.losses) == (2, 1, 2)
    means = [2 * x / 3 for x in (5.0, 6.0, 90.0)]
    assert pair.episode_return.difference.value == pytest.approx(2.0 - np.mean(means))


def test_a_curve_over_seeds_keeps_to_the_steps_they_share():
    curves = [
        [ReturnPoint(0, 1.0, 0.0, 2.0), ReturnPoint(10, 3.0, 2.0, 4.0)],
        [ReturnPoint(0, 2.0, 1.0, 3.0), ReturnPoint(20, 9.0, 8.0, 9.5)],
    ]
    found = compared(a=[return_report_of([1.0], curve=curve) for curve in curves])
    assert found.runs[0].learning_curve == (ReturnPoint(0, 1.5, 1.0, 2.0),)


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"environment": "walker:Walker"}, "environment = 'walker:Walker', and not"),
        ({"environment_options": {"speed": 2}}, "environment_options = {'speed': 2}, and not {}"),
        ({"task": {"episode_length": 7}}, "task.episode_length = 7, and not"),
    ],
)
def test_runs_of_different_environments_are_refused(settings, key):
    one, other = return_report_of([1.0]), return_report_of([1.0], **settings)
    check_one_environment({"a": one.config, "b": one.config})
    with pytest.raises(UserError, match=key):
        check_one_environment({"a": one.config, "b": other.config})


def test_runs_with_other_code_of_one_name_are_told():
    code = {
        "a": TaskCode("env", (("env.py", b"1"), ("terms.py", b"2"))),
        "b": TaskCode("env", (("env.py", b"1"), ("terms.py", b"2"))),
        "c": TaskCode("env", (("env.py", b"3"), ("other.py", b"2"))),
        "installed": None,
    }
    assert compare_code({name: code[name] for name in ("a", "b")}) == ()
    assert compare_code(code) == (
        "the environments of a and c are not the same code: env.py differs, only c has other.py,"
        " only a has terms.py: their returns may not be comparable",
        "the environments of a and installed are not the same code: only a has env.py, only a has"
        " terms.py: their returns may not be comparable",
    )


def test_reports_and_comparisons_are_shown_in_one_line():
    one = return_report_of([1.0, 2.0])
    assert repr(one) == (
        "ReturnReport(run='runs/a', env_steps=2048, return=1.50, folder='runs/a/evaluations/2048')"
    )
    assert repr(compared(a=[one])) == "ReturnComparison(return={'a': '1.50'}, folder='somewhere')"
