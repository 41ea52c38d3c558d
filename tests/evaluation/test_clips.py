"""Which episodes a report shows clips of, and a report without OpenGL."""

import numpy as np
import pytest

from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import evaluate_run
from jetbot_mjx.evaluation.clips import Clip, clip_goals


class Outcomes:
    def __init__(self, success):
        self.success = np.array(success, float)


@pytest.mark.parametrize(
    ("success", "goals"),
    [
        ([1, 1, 1, 1], [0, 1, 2]),
        ([0, 1, 0, 1, 1, 1], [1, 3, 4, 0, 2]),
        ([0] * 9, [0, 1, 2, 3, 4]),
    ],
)
def test_three_successes_and_the_first_failures_are_shown(success, goals):
    assert clip_goals(Outcomes(success)) == goals


@pytest.mark.slow
def test_a_report_shows_its_clips_or_why_it_has_none(smoke_run, tmp_path, blank_figures):
    def make(env, episodes, goals):
        return [Clip(goal, bool(episodes.success[goal] > 0), 2, b"mp4") for goal in goals]

    def refuse(env, episodes, goals):
        raise UserError("no OpenGL to render with: install libegl1")

    report = evaluate_run(smoke_run, episodes=8, output=tmp_path / "with", clips=make)
    page = (report.folder / "report.html").read_text("utf-8")
    assert page.count("<video") == len(report.clips) > 0
    assert "data:video/mp4;base64,bXA0" in page
    assert "2 times as fast" in page
    report = evaluate_run(smoke_run, episodes=8, output=tmp_path / "without", clips=refuse)
    page = (report.folder / "report.html").read_text("utf-8")
    assert "This report has no clips: no OpenGL to render with: install libegl1." in page
    report = evaluate_run(smoke_run, episodes=8, output=tmp_path / "none")
    assert "Clips" not in (report.folder / "report.html").read_text("utf-8")
