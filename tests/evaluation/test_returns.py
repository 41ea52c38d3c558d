"""Returns of episodes of an environment of one's own."""

import numpy as np
import pytest

from jetbot_mjx.evaluation.returns import summarize_returns
from jetbot_mjx.evaluation.rollout import ReturnEpisodes


def episodes(returns, **changed):
    returns = np.asarray(returns, np.float32)
    zeros = np.zeros(returns.size, np.float32)
    fields = dict.fromkeys(ReturnEpisodes._fields, zeros) | {"qpos": None}
    return ReturnEpisodes(**(fields | {"episode_return": returns} | changed))


def test_a_mean_has_the_interval_of_a_normal_distribution():
    one = summarize_returns(episodes([1, 2, 3, 6]), has_success=False)
    assert (one.episodes, one.episode_return, one.return_min) == (4, 3, 1)
    half = 1.959964 * np.std([1, 2, 3, 6], ddof=1) / 2
    assert (one.return_low, one.return_high) == pytest.approx((3 - half, 3 + half))
    assert one.score == 3


def test_of_one_episode_there_is_no_interval():
    one = summarize_returns(episodes([5]), has_success=False)
    assert one.return_low == one.return_high == 5


def test_successes_are_the_score_where_there_are_any():
    won = np.array([1, 0, 1, 1], np.float32)
    one = summarize_returns(episodes([1, 2, 3, 6], success=won), has_success=True)
    assert one.success_rate == one.score == 0.75
    assert one.success_low < 0.75 < one.success_high
    assert summarize_returns(episodes([1], success=won[:1]), has_success=False).success_rate is None
