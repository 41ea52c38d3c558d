"""Episodes made by hand, with reports on them and comparisons of reports."""

from pathlib import Path

import numpy as np

from jetbot_mjx.config import parse_config
from jetbot_mjx.evaluation.comparison import compare
from jetbot_mjx.evaluation.evaluator import summarize
from jetbot_mjx.evaluation.report import Report, by_goal, find_failures
from jetbot_mjx.evaluation.return_report import ReturnReport
from jetbot_mjx.evaluation.returns import summarize_returns
from jetbot_mjx.evaluation.rollout import Episodes, ReturnEpisodes

CTRL_DT = 1 / 60


def make_episodes(goals_w, won, steps=60, **changed):
    """Episodes from the origin that end on the goal, or 0.3 m before it."""
    goals_w = np.column_stack([np.asarray(goals_w, np.float32), np.full(len(goals_w), 0.05)])
    won = np.asarray(won, np.float32)
    count = won.size
    distance = np.linalg.norm(goals_w[:, :2], axis=-1, keepdims=True)
    zeros = np.zeros(count, np.float32)
    fields = {
        "success": won,
        "steps": np.broadcast_to(np.asarray(steps, np.float32), count),
        "episode_return": zeros,
        "terminated": won,
        "nonfinite": zeros,
        "path_length": distance[:, 0],
        "start_w": np.zeros((count, 2), np.float32),
        "start_yaw": zeros,
        "end_w": np.where(won[:, None] > 0, 1.0, 1.0 - 0.3 / distance) * goals_w[:, :2],
        "goal_w": goals_w,
        "goal": None,
        "qpos": None,
    }
    return Episodes(**{**fields, **changed})


def make_report(episodes, run_dir="runs/a", curve=(), env_steps=2048, settings=None):
    """A report of episodes made by hand, without baselines."""
    return Report(
        folder=Path(run_dir) / "evaluations" / "2048",
        run=Path(run_dir),
        checkpoint=Path(run_dir) / "checkpoints" / f"{env_steps:012d}",
        env_steps=env_steps,
        config=parse_config(settings or {}),
        policy=summarize(episodes, CTRL_DT),
        baselines={},
        goal_bins=by_goal(episodes, CTRL_DT),
        failures=find_failures(episodes, Path(run_dir), env_steps),
        learning_curve=tuple(curve),
        episodes=episodes,
        versions={},
    )


def polar(distance, degrees):
    angle = np.radians(degrees)
    return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)


TEN_GOALS = np.stack([np.linspace(0.3, 1.0, 10), np.zeros(10)], axis=-1)


def report_of(won, steps=60, **more):
    return make_report(make_episodes(TEN_GOALS, won, steps), **more)


def wins(count):
    return np.arange(10) < count


def comparison_of(**runs):
    named = {
        name: {f"seed-{i}": one for i, one in enumerate(seeds)} for name, seeds in runs.items()
    }
    return compare(Path("somewhere"), named)


def return_report_of(returns, run_dir="runs/a", curve=(), steps=10, **settings):
    """A report of episodes in an environment of one's own, of which these are the returns."""
    count = len(returns)
    zeros = np.zeros(count, np.float32)
    episodes = ReturnEpisodes(
        success=zeros,
        steps=np.full(count, steps, np.float32),
        episode_return=np.asarray(returns, np.float32),
        terminated=zeros,
        nonfinite=zeros,
        qpos=None,
        metrics={},
    )
    return ReturnReport(
        folder=Path(run_dir) / "evaluations" / "2048",
        run=Path(run_dir),
        checkpoint=Path(run_dir) / "checkpoints" / "000000002048",
        env_steps=2048,
        config=parse_config({"environment": "hopper:Hopper", **settings}),
        dt=None,
        policy=summarize_returns(episodes, has_success=False),
        baselines={},
        learning_curve=tuple(curve),
        episodes=episodes,
        versions={},
    )
