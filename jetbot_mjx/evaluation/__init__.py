"""Evaluate policies on fixed goals, compare them and write reports."""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.evaluation.comparison import Comparison as Comparison
    from jetbot_mjx.evaluation.evaluate_runs import Simulator as Simulator
    from jetbot_mjx.evaluation.evaluate_runs import compare_runs as compare_runs
    from jetbot_mjx.evaluation.evaluate_runs import evaluate_in_mujoco as evaluate_in_mujoco
    from jetbot_mjx.evaluation.evaluate_runs import evaluate_run as evaluate_run
    from jetbot_mjx.evaluation.evaluator import Evaluator as Evaluator
    from jetbot_mjx.evaluation.evaluator import report_keys as report_keys
    from jetbot_mjx.evaluation.html_report import write_comparison as write_comparison
    from jetbot_mjx.evaluation.html_report import write_report as write_report
    from jetbot_mjx.evaluation.report import Report as Report

__getattr__, __dir__ = load_lazily(__name__)
