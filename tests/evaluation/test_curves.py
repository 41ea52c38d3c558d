"""Curves hold the lines of the metrics that tell their quantities, in the order of the steps."""

import pytest

from jetbot_mjx.evaluation.curves import CurvePoint, LossPoint, ReturnPoint, band, read_curve
from jetbot_mjx.runs import History


def history(*lines):
    return [History(steps, 0.0, metrics) for steps, metrics in lines]


def test_a_curve_of_success_is_made_of_the_evaluations_alone():
    told = {f"eval/{name}": 0.5 for name in CurvePoint._fields[1:]}
    lines = history(
        (2048, {**told, "eval/time_to_goal_median": None}),
        (0, told),
        (4096, {"loss/total": 1.0}),
        (6144, {**told, "eval/success_rate": None}),
    )
    assert read_curve(CurvePoint, lines) == (
        CurvePoint(0, 0.5, 0.5, 0.5, 0.5),
        CurvePoint(2048, 0.5, 0.5, 0.5, None),
    )


def test_a_curve_of_returns_has_the_evaluations_that_tell_one():
    told = {"eval/episode_return": 2.0, "eval/return_low": 1.0, "eval/return_high": 3.0}
    lines = history((2048, told), (0, {**told, "eval/episode_return": 0.5}), (4096, {"x": 1.0}))
    points = ReturnPoint(0, 0.5, 1.0, 3.0), ReturnPoint(2048, 2.0, 1.0, 3.0)
    assert read_curve(ReturnPoint, lines) == points


def test_losses_are_of_lines_that_have_all_of_them():
    told = {"loss/policy": 0.1, "loss/value": 0.2, "policy/kl": 0.3}
    lines = history((0, {"eval/success_rate": 0.5}), (8, told), (16, {**told, "policy/kl": None}))
    assert read_curve(LossPoint, lines) == (LossPoint(8, 0.1, 0.2, 0.3),)


def test_a_band_is_over_the_steps_that_all_seeds_share():
    curves = [
        [ReturnPoint(0, 1.0, 0.0, 2.0), ReturnPoint(10, 3.0, 2.0, 4.0)],
        [ReturnPoint(0, 2.0, 1.0, 3.0), ReturnPoint(20, 9.0, 8.0, 9.5)],
    ]
    assert band(curves) == (ReturnPoint(0, 1.5, 1.0, 2.0),)
    assert band(curves[:1]) == tuple(curves[0])
    assert band([curves[0], []]) == ()
    rates = [[CurvePoint(0, rate, 0.0, 1.0, 2.5)] for rate in (0.2, 0.6)]
    assert band(rates)[0] == pytest.approx(CurvePoint(0, 0.4, 0.2, 0.6), abs=1e-12, nan_ok=True)
