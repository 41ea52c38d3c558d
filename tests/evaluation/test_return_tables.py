"""The lines about returns for the terminal."""

from pathlib import Path

from helpers.reports import return_report_of
from jetbot_mjx.evaluation.return_report import compare_returns
from jetbot_mjx.evaluation.return_tables import (
    summarize_return_comparison,
    summarize_return_report,
)


def test_a_report_shows_the_policy_and_the_baselines():
    report = return_report_of([1.0, 2.0])
    zero = report.policy._replace(episode_return=-3.5, success_rate=0.25)
    lines = summarize_return_report(report._replace(baselines={"zero": zero})).splitlines()
    assert lines[0] == "2 fixed starts, policy after 2,048 steps"
    assert lines[2].split() == ["policy", "1.50", "0.52", "..", "2.48", "1.00", "10.0", "-"]
    assert lines[3].split()[0:2] + lines[3].split()[-1:] == ["zero", "-3.50", "25.00%"]
    assert lines[-1] == "report: runs/a/evaluations/2048/report.html"
    broken = report._replace(policy=report.policy._replace(nonfinite_envs=2))
    assert summarize_return_report(broken).endswith("\n2 episodes ended in a non-finite state")


def test_a_comparison_shows_policies_runs_and_pairs():
    runs = {
        "a": {"seed-0": return_report_of([1.0, 2.0]), "seed-1": return_report_of([3.0, 4.0])},
        "b": {"seed-0": return_report_of([0.0, 9.0])},
    }
    lines = summarize_return_comparison(compare_returns(Path("there"), runs)).splitlines()
    assert lines[0] == "2 fixed starts, 3 policies"
    assert [line.split()[:2] for line in lines[2:4]] == [["a", "seed-0"], ["a", "seed-1"]]
    assert any(line.startswith("a ") and line.endswith("2 seeds") for line in lines)
    assert any(line.startswith("b ") and line.endswith("2 episodes") for line in lines)
    assert sum(line.startswith("intervals over few seeds") for line in lines) == 1
    assert lines[-2].startswith("a against b: difference -2.00")
    assert lines[-2].endswith(", starts of the first seed of each 1 : 1 (p 1)")
    assert lines[-1] == "report: there/comparison.html"


def test_a_return_that_rounds_to_zero_has_no_sign():
    line = summarize_return_report(return_report_of([-1e-3, 1e-3])).splitlines()[2]
    assert line.split() == ["policy", "0.00", "0.00", "..", "0.00", "0.00", "10.0", "-"]
