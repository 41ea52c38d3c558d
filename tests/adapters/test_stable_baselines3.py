"""The environment for Stable-Baselines3: its own checker, its PPO, and what its PPO relies on."""

import itertools
import re
import sys

import jax.numpy as jnp
import numpy as np
import pytest

sb3 = pytest.importorskip("stable_baselines3")
torch = pytest.importorskip("torch")

import gymnasium
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecMonitor

from helpers.gliding import everywhere
from jetbot_mjx.adapters import JetBotGymEnv, JetBotVectorEnv
from jetbot_mjx.adapters.stable_baselines3 import JetBotVecEnv
from jetbot_mjx.envs.opengl import find_backend
from jetbot_mjx.errors import UserError

GOAL = slice(13, 16)
BATCHES = (JetBotVecEnv, JetBotVectorEnv)
ENDS = {"task": {"success_radius": 0.75}}  # near goals are reached within some steps
GAMMA = 0.9

# The tutorial's, but for its layers that Stable-Baselines3 no longer shares.
TUTORIAL = {
    "n_steps": 2560,
    "batch_size": 64,
    "learning_rate": 0.000125,
    "gamma": 0.9,
    "ent_coef": 7.5e-08,
    "clip_range": 0.3,
    "n_epochs": 5,
    "gae_lambda": 1.0,
    "max_grad_norm": 0.9,
    "vf_coef": 0.95,
    "device": "cpu",
    "policy_kwargs": {
        "activation_fn": torch.nn.Tanh,
        "net_arch": {"pi": [128] * 3, "vf": [128] * 3},
    },
}


@pytest.fixture(autouse=True)
def one_thread():
    """Small networks; and two cores are shared with the other workers."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def needs_opengl():
    try:
        find_backend()
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def vec_env():
    """Four robots that glide, and compile in no time; episodes end in both ways."""
    with everywhere():
        env = JetBotVecEnv(4, max_episode_length=8, config=ENDS)
        env.reset()
        env.step(np.zeros((4, 2)))
        yield env


def test_its_checker_passes():
    check_env(JetBotGymEnv())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "shorter"),
    [(1024, {"n_steps": 512}), pytest.param(20_000, {}, marks=pytest.mark.slow)],
)
def test_its_ppo_learns_with_the_tutorials_hyperparameters(steps, shorter):
    ppo = sb3.PPO("MlpPolicy", JetBotGymEnv(), seed=0, **TUTORIAL | shorter)
    before = [x.detach().clone() for x in ppo.policy.parameters()]
    ppo.learn(steps)
    assert ppo.num_timesteps >= steps
    assert len(ppo.ep_info_buffer) >= steps // 256
    assert len(ppo.ep_success_buffer) == len(ppo.ep_info_buffer)
    after = list(ppo.policy.parameters())
    assert all(torch.isfinite(x).all() for x in after)
    assert any((x != y).any() for x, y in zip(before, after, strict=True))


def test_a_step_before_the_first_reset_is_refused():
    env = JetBotVecEnv(2, render_mode="rgb_array")
    for act in (lambda: env.step(np.zeros((2, 2))), env.render):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) before"):
            act()


@pytest.mark.parametrize("task", ["gates", pytest.param("pillars", marks=pytest.mark.slow)])
@everywhere()
def test_a_batch_is_that_of_gymnasium(task, root, monkeypatch):
    """Also where a goal advances, and of a model with more bodies; both glide alike."""
    monkeypatch.syspath_prepend(str(root / "examples"))
    config = root / "examples" / f"{task}.yaml"
    ours, theirs = (make(4, max_episode_length=40, config=config) for make in BATCHES)
    np.testing.assert_array_equal(ours.reset(), theirs.reset()[0])
    for action in np.random.default_rng(0).uniform(-1, 1, (100, 4, 2)).astype(np.float32):
        obs, reward, done, infos = ours.step(action)
        wanted, rewards, terminated, truncated, _ = theirs.step(action)
        np.testing.assert_array_equal(obs, wanted)
        np.testing.assert_array_equal(reward, rewards)
        np.testing.assert_array_equal(done, terminated | truncated)
        for index in np.flatnonzero(done):
            assert infos[index]["TimeLimit.truncated"] == truncated[index]


class StepRecorder(VecEnvWrapper):
    """A wrapper that stores what the environments return, before a trainer adds to it."""

    def __init__(self, venv):
        super().__init__(venv)
        self.rewards, self.dones, self.infos = [], [], []

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        self.rewards.append(rewards.copy())
        self.dones.append(dones.copy())
        self.infos.append(infos)
        return obs, rewards, dones, infos


class Rewards(BaseCallback):
    """A callback that stores the rewards of PPO's buffer, and the values of final observations."""

    def __init__(self):
        super().__init__()
        self.seen, self.values = [], {}

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = self.model.rollout_buffer
        first = len(self.seen)
        self.seen += list(buffer.rewards.copy())
        for step in range(first, len(self.seen)):
            for index, info in enumerate(self.training_env.infos[step]):
                if "terminal_observation" in info:
                    final = self.model.policy.obs_to_tensor(info["terminal_observation"])[0]
                    with torch.no_grad():
                        value = self.model.policy.predict_values(final)
                    self.values[step, index] = float(value)


@pytest.mark.parametrize("adapter", ["gym", "vec"])
def test_a_truncated_episode_is_bootstrapped_and_one_that_arrived_is_not(adapter, vec_env):
    if adapter == "gym":
        env = DummyVecEnv([lambda: JetBotGymEnv(max_episode_length=8, config=ENDS)] * 2)
    else:
        env = vec_env
    recorder, callback = StepRecorder(env), Rewards()
    ppo = sb3.PPO("MlpPolicy", recorder, gamma=GAMMA, n_steps=32, batch_size=32, n_epochs=1, seed=0)
    ppo.learn(3 * 32 * env.num_envs, callback=callback)
    seen, told = np.array(callback.seen), np.array(recorder.rewards)
    kinds = {True: 0, False: 0}
    for step, index in itertools.product(*map(range, seen.shape)):
        added = seen[step, index] - told[step, index]
        if not recorder.dones[step][index]:
            assert added == 0
            continue
        info = recorder.infos[step][index]
        truncated = info["TimeLimit.truncated"]
        assert truncated != info["is_success"]
        kinds[truncated] += 1
        wanted = GAMMA * callback.values[step, index] if truncated else 0.0
        assert added == pytest.approx(wanted, abs=1e-5)
        assert not truncated or abs(wanted) > 1e-4  # it would be seen
    assert min(kinds.values()) >= 5


def test_the_terminal_observation_is_the_old_episodes_and_obs_the_new_ones(vec_env):
    before = vec_env.reset()
    ended = 0
    for _ in range(30):
        obs, _, dones, infos = vec_env.step(np.ones((4, 2)) * [1.0, 0.0])
        for index in range(4):
            assert ("terminal_observation" in infos[index]) == dones[index]
            if not dones[index]:
                continue
            ended += 1
            final = infos[index]["terminal_observation"]
            np.testing.assert_array_equal(final[GOAL], before[index, GOAL])
            assert (obs[index, GOAL] != before[index, GOAL]).any()
            assert final[0] > before[index, 0]
            assert np.linalg.norm(obs[index, :2]) == 0
        before = obs
    assert ended > 10


def test_its_monitor_counts_episodes_and_successes(vec_env):
    monitor = VecMonitor(vec_env, info_keywords=("is_success",))
    monitor.reset()
    sums, counted = np.zeros(4), []
    for _ in range(30):
        _, rewards, dones, infos = monitor.step(np.zeros((4, 2)))
        sums += rewards
        for index in np.flatnonzero(dones):
            episode = infos[index]["episode"]
            assert episode["r"] == pytest.approx(sums[index], abs=1e-5)
            assert episode["is_success"] == (episode["l"] < 8) or episode["l"] == 8
            counted.append(episode["is_success"])
            sums[index] = 0
    assert set(counted) == {True, False}


def test_a_seed_begins_the_same_streams_and_each_environment_has_its_own(vec_env):
    def goals():
        seen = [vec_env.reset()]
        for _ in range(24):
            obs, _, dones, _ = vec_env.step(np.zeros((4, 2)))
            seen.append(obs[dones])
        return np.concatenate(seen)[:, GOAL]

    assert list(vec_env.seed(3)) == [3, 4, 5, 6]
    first = goals()
    vec_env.seed(3)
    np.testing.assert_array_equal(goals(), first)
    assert len(np.unique(first[:, 0])) == len(first) >= 12
    np.testing.assert_array_equal(first[1], JetBotGymEnv().reset(seed=4)[0][GOAL])
    assert not set(goals()[:, 0]) & set(first[:, 0])  # without a seed it goes on


def test_attributes_are_those_of_the_environments_or_kept_beside_them(vec_env):
    assert vec_env.get_attr("dt") == [1 / 60] * 4
    assert vec_env.get_attr("config", indices=[0, 2])[1].task.episode_length == 8
    assert vec_env.has_attr("render_mode")
    assert not vec_env.has_attr("nothing")
    vec_env.set_attr("level", 3, indices=[1, 2])
    vec_env.set_attr("level", 4, indices=2)
    assert vec_env.get_attr("level") == [None, 3, 4, None]
    with pytest.raises(UserError, match="config cannot be set: the environments are one compiled"):
        vec_env.set_attr("config", None)
    (speeds,) = vec_env.env_method("wheel_targets", jnp.array([-1.0, 0.0]), indices=0)
    np.testing.assert_array_equal(speeds, [0, 0])
    with pytest.raises(AttributeError):
        vec_env.env_method("nothing")
    assert vec_env.env_is_wrapped(Monitor) == [False] * 4


def test_robots_are_drawn_side_by_side(needs_opengl):
    with everywhere():
        env = JetBotVecEnv(2, render_mode="rgb_array")
        env.reset()
    image = env.render()
    assert image.shape == (960, 480, 3) or image.shape == (480, 960, 3)
    assert image.std() > 5
    env.close()


@pytest.mark.parametrize(
    "options", [["--num-envs", "1"], ["--num-envs", "4"], ["--camera"]], ids=" ".join
)
def test_the_examples_train_and_evaluate(options, root, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(root / "examples"))
    for name in ("sb3_train", "sb3_eval"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import sb3_eval
    import sb3_train

    monkeypatch.setattr(sb3_train, "_STEPS", 64)
    folder = ["--folder", str(tmp_path)]
    with everywhere():
        assert sb3_train.main(["--steps", "64", *options, *folder]) == 0
    policy = str(tmp_path / "jetbot.zip")
    assert sb3_eval.main(["--policy", policy, "--episodes", "2", "--headless"]) == 0
    assert re.search(r"^[012] of 2 goals, \d+ steps", capsys.readouterr().out, re.MULTILINE)
    with pytest.raises(UserError, match="does not exist"):
        sb3_eval.main(["--policy", "nothing"])


SEES = {"task": {"observation": "camera"}, "camera": {"width": 36, "height": 36}}


def test_its_own_cnn_policy_trains_on_images():
    env = JetBotVecEnv(2, config=SEES)
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (36, 36, 3), np.uint8)
    model = sb3.PPO("CnnPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu")
    model.learn(16)
    assert model.rollout_buffer.observations.dtype == np.uint8
    assert model.rollout_buffer.observations.std() > 10


def test_an_episodes_last_image_is_given_before_the_next_episodes_first():
    env = JetBotVecEnv(3, max_episode_length=24, config=SEES)
    before = env.reset()
    for _ in range(24):
        obs, _, done, infos = env.step(np.tile(np.float32([-1.0, 1.0]), (3, 1)))
    assert done.all()
    for index, info in enumerate(infos):
        last = info["terminal_observation"]
        assert last.shape == (36, 36, 3)
        # The robot has turned, and a new episode begins where the first one began, elsewhere aimed.
        assert np.abs(last.astype(int) - obs[index]).mean() > 1
        assert (
            np.abs(obs[index].astype(int) - before[index]).mean()
            < np.abs(last.astype(int) - before[index]).mean()
        )


def test_numbers_beside_an_image_are_a_dictionary():
    sees = {**SEES, "task": {"observation": "camera+egocentric"}}
    env = JetBotVecEnv(2, config=sees)
    obs = env.reset()
    assert set(obs) == {"pixels/front", "state"}
    assert env.observation_space.contains({name: part[0] for name, part in obs.items()})
    both = JetBotVectorEnv(2, config=sees)
    seen, _ = both.reset(seed=0)
    assert both.observation_space.contains(seen)


@pytest.mark.parametrize(
    "observation", ["camera", pytest.param("camera+egocentric", marks=pytest.mark.slow)]
)
def test_its_checker_passes_with_images(observation):
    check_env(JetBotGymEnv(config={**SEES, "task": {"observation": observation}}))
