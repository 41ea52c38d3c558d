"""The batch of environments for Gymnasium: the same in MJX as one robot is in C MuJoCo."""

from pathlib import Path

import jax
import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from helpers.gliding import everywhere
from helpers.gymnasium_cases import ENDS, GOAL, ID, sees
from jetbot_mjx.adapters import JetBotGymEnv, JetBotVectorEnv
from jetbot_mjx.adapters.arguments import key_from_seed
from jetbot_mjx.config import load_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import UserError

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def gliding():
    """Four robots that glide, and compile in no time; episodes end in both ways."""
    with everywhere():
        vector = JetBotVectorEnv(4, max_episode_length=8, config=ENDS)
        vector.reset(seed=0)
        vector.step(np.zeros((4, 2)))
        yield vector


NEAR = {"episode_length": 128, "success_radius": 0.4}

TASKS = [
    pytest.param({"task": NEAR}, id="world", marks=pytest.mark.slow),
    # The observation of most of the examples.
    pytest.param(
        {"task": {**NEAR, "observation": "egocentric"}}, id="egocentric", marks=pytest.mark.slow
    ),
    pytest.param({"task": NEAR, "robot": {"preset": "real"}}, id="real", marks=pytest.mark.slow),
    *(
        pytest.param(path, id=path.stem, marks=[] if path.stem == "pillars" else pytest.mark.slow)
        for path in sorted((ROOT / "examples").glob("*.yaml"))
    ),
]
"""Every task that is shipped, and every example; solid bodies stand in that of the pillars."""

TOLERANCES = {"m": 1e-3, "m/s": 2e-3, "rad/s": 2e-2, "1": 1e-3}
"""By an observation's unit. C MuJoCo computes in float64 and searches along a line in another way
than MJX: where wheels slide, and where a pillar is struck, 16 robots were 0.1 mm apart after some
seconds, and 1 mrad. A full-speed step covers 17 mm; a pillar elsewhere would tell in decimetres."""


@pytest.mark.slow
@pytest.mark.parametrize("config", TASKS)
def test_every_task_is_the_same_in_c_in_the_batch_and_in_training(config, monkeypatch):
    """Compare episodes to their end and on, with the infos that Gymnasium prescribes."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    if isinstance(config, Path):
        config = load_config(config)
    ours = JetBotVectorEnv(4, config=config)
    theirs = SyncVectorEnv(
        [lambda: JetBotGymEnv(config=config)] * 4, autoreset_mode=AutoresetMode.SAME_STEP
    )
    env = make_env(ours.config)
    training = wrap_for_training(env, ours.config.task.episode_length)
    step = jax.jit(training.step)
    seen = ours.reset(seed=2)[0]
    state = jax.jit(training.reset)(np.stack([key_from_seed(seed) for seed in range(2, 6)]))
    np.testing.assert_allclose(seen, theirs.reset(seed=2)[0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(seen, state.obs, rtol=0, atol=1e-6)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    rng, ends, held = np.random.default_rng(0), [], np.zeros((4, 2))
    for index in range(300):
        if index % 16 == 0:
            held = rng.uniform(-1.2, 1.2, (4, 2)).astype(np.float32)
        action = _towards(seen, held, env.task.layout)
        mine, wanted, state = ours.step(action), theirs.step(action), step(state, action)
        seen = mine[0]
        _check_same_obs(seen, wanted[0], env.task.layout)
        np.testing.assert_allclose(mine[1], wanted[1], atol=1e-4)
        for flags, others in zip(mine[2:4], wanted[2:4], strict=True):
            assert flags.dtype == others.dtype
            np.testing.assert_array_equal(flags, others)
        _check_same_infos(mine[4], wanted[4], env.task.layout)
        for flags, name in zip(mine[2:4], ("terminated", "truncation"), strict=True):
            np.testing.assert_array_equal(flags, state.info[name])
        np.testing.assert_allclose(seen, state.obs, atol=1e-6)
        np.testing.assert_allclose(mine[1], state.reward, atol=1e-7)
        for pose, one in zip(ours.batch.poses(), theirs.envs, strict=True):
            _check_same_goal(pose.goal, one.unwrapped.robot.goal)
        _check_same_goal(ours.batch._state.goal, state.goal)
        ends += [*mine[2][mine[2] | mine[3]]]
    assert len(ends) >= 4


def _towards(obs, held, layout):
    """Return actions that turn towards the first direction that a task observes."""
    starts = dict(zip((field.name for field in layout), _starts(layout), strict=True))
    start = next((start for name, start in starts.items() if name.endswith("direction")), None)
    if start is None:
        return held
    bearing = np.arctan2(obs[:, start + 1], obs[:, start])
    drive = np.where(np.abs(bearing) < 0.5, 0.3 + 0.3 * held[:, 0], -1.0)
    return np.stack([drive, bearing + 0.2 * held[:, 1]], axis=1).astype(np.float32)


def _starts(layout):
    return np.cumsum([0, *(field.size for field in layout)])[:-1]


def _check_same_obs(mine, wanted, layout):
    assert mine.dtype == wanted.dtype
    for field, start in zip(layout, _starts(layout), strict=True):
        part = np.s_[..., start : start + field.size]
        bound = TOLERANCES[field.unit]
        np.testing.assert_allclose(mine[part], wanted[part], atol=bound, err_msg=field.name)


def _check_same_goal(mine, wanted):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-6), mine, wanted)


def _check_same_infos(mine, wanted, layout):
    assert set(mine) == set(wanted)
    for name, value in wanted.items():
        if isinstance(value, dict):
            _check_same_infos(mine[name], value, layout)
        elif name == "final_obs":
            for one, other in zip(mine[name], value, strict=True):
                assert (one is None) == (other is None)
                if one is not None:
                    _check_same_obs(one, other, layout)
        else:
            assert mine[name].dtype == value.dtype
            np.testing.assert_array_equal(mine[name], value)


def test_one_robot_sees_what_the_batch_sees():
    config = sees("camera+egocentric", frames=2)
    ours = JetBotVectorEnv(2, max_episode_length=12, config=config)
    theirs = SyncVectorEnv(
        [lambda: JetBotGymEnv(max_episode_length=12, config=config)] * 2,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    mine, wanted = ours.reset(seed=2)[0], theirs.reset(seed=2)[0]
    action, before = np.float32([[-0.5, 1.0], [0.5, -1.0]]), None
    for index in range(20):
        assert mine.keys() == wanted.keys()
        np.testing.assert_allclose(mine["state"], wanted["state"], atol=2e-3)
        image, other = mine["pixels/front"], wanted["pixels/front"].astype(int)
        assert other.std() > 10
        # A border between two surfaces may lie on the other side of a ray.
        assert np.mean(np.abs(image - other) > 2) < 5e-3, index
        if before is None or index == 12:
            np.testing.assert_array_equal(other[..., :3], other[..., 3:])
        else:
            np.testing.assert_array_equal(other[..., :3], before[..., 3:])
            assert (other[..., :3] != other[..., 3:]).any()
        before = other
        mine, wanted = ours.step(action)[0], theirs.step(action)[0]


def test_randomized_robots_need_the_batch():
    drawn = {"randomization": {"friction": [0.5, 1.0], "mass": [0.9, 1.1]}}
    with pytest.raises(UserError, match=r"randomization\.friction, mass: .*use JetBotVectorEnv"):
        JetBotGymEnv(config=drawn)
    with everywhere():
        batch = JetBotVectorEnv(num_envs=3, config=drawn)
        batch.reset(seed=0)
        batch.step(np.zeros((3, 2)))


def test_every_environment_draws_goals_of_its_own(gliding):
    seen = [gliding.reset(seed=0)[0][:, GOAL]]
    for _ in range(40):
        obs, _, terminated, truncated, infos = gliding.step(np.zeros((4, 2)))
        done = terminated | truncated
        for index in np.flatnonzero(done):
            # The end belongs to the old episode, the observation to the new one.
            assert tuple(infos["final_obs"][index][GOAL]) in {
                tuple(x) for x in np.concatenate(seen)
            }
            assert np.linalg.norm(obs[index, :2]) < 1e-6
        seen.append(obs[done, GOAL])
    seen = np.concatenate(seen)
    assert len(seen) > 20
    assert len(np.unique(seen[:, 0])) == len(seen)


def test_a_batch_takes_one_seed_or_one_for_each(gliding):
    one = gliding.reset(seed=7)[0]
    np.testing.assert_array_equal(gliding.reset(seed=[7, 8, 9, 10])[0], one)
    np.testing.assert_array_equal(one[2], JetBotGymEnv().reset(seed=9)[0])
    on = gliding.reset()[0]
    np.testing.assert_array_equal(gliding.reset(seed=[None, 8, None, 10])[0][[1, 3]], one[[1, 3]])
    assert not (on[:, 13] == one[:, 13]).any()
    for seed, said in ([1, 2], "seed has 2 numbers"), (-1, "seed = -1"):
        with pytest.raises(UserError, match=said):
            gliding.reset(seed=seed)


def test_gymnasiums_statistics_count_whole_episodes(gliding):
    counted = RecordEpisodeStatistics(gliding)
    counted.reset(seed=0)
    lengths = []
    for _ in range(30):
        *_, infos = counted.step(np.zeros((4, 2)))
        if "episode" in infos:
            lengths += list(infos["episode"]["l"][infos["_episode"]])
    assert max(lengths) == 8
    assert min(lengths) < 8
    assert sum(lengths) <= 120


def test_the_arrays_of_a_step_belong_to_the_caller(gliding):
    gliding.reset(seed=0)
    obs, rewards, terminated, *_ = gliding.step(np.zeros((4, 2)))
    before = obs.copy(), rewards.copy(), terminated.copy()
    gliding.step(np.ones((4, 2)))
    for array, kept in zip((obs, rewards, terminated), before, strict=True):
        np.testing.assert_array_equal(array, kept)
        array[:] = 0  # and may be written to


def test_a_batch_is_made_by_its_name():
    vector = gymnasium.make_vec(ID, num_envs=3, max_episode_length=9)
    assert isinstance(vector, JetBotVectorEnv)
    assert vector.num_envs == 3
    assert vector.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert vector.config.task.episode_length == 9
    with pytest.raises(UserError, match="num_envs = 0"):
        JetBotVectorEnv(0)


def test_a_batch_shows_every_robot_or_the_first_in_a_window(window, needs_opengl):
    with everywhere():
        vector = JetBotVectorEnv(2, render_mode="rgb_array")
        obs, _ = vector.reset(seed=0)
        frames = vector.render()
        assert [frame.shape for frame in frames] == [(480, 480, 3)] * 2
        assert (frames[0] != frames[1]).any()
        vector.close()
        vector = JetBotVectorEnv(2, render_mode="human")
        obs, _ = vector.reset(seed=0)
    np.testing.assert_allclose(window.shown[-1][1][0], obs[0, GOAL], atol=1e-6)
    assert vector.render() is None
    vector.close()
    assert window.shown[-1] == "closed"
