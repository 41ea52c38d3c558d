"""Pages of robots and tasks of one's own, whose functions are compiled for them; in Node."""

import jax
import numpy as np
import pytest

from helpers.untrained import write_untrained_run
from helpers.web_pages import page_of
from jetbot_mjx.config import load_config
from jetbot_mjx.deployment.web_page import page_data
from jetbot_mjx.envs import BatchWrapper, EpisodeWrapper, KernelWrapper, NewEpisodeWrapper
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.runs.checkpoint import load_checkpoint
from onekernel import cpu, wasm

pytest.importorskip("llvmlite")

OWN = ("turtlebot", "rover", "car", "gates", "obstacle", "pillars")
SMALL = (
    "ppo.network.policy_hidden_layer_sizes=[16]",
    "ppo.network.value_hidden_layer_sizes=[16]",
)

ROBOTS, STEPS = 9, 150

DRIVE = """
const fleet = engine.fleet(given.count, 0), qpos = [], poses = [];
fleet.keys.view.set(given.keys);
fleet.begin();
for (let at = 0; at < given.commands.length; at += 2 * given.count) {
  for (let robot = 0; robot < given.count; robot++)
    fleet.drive(robot, given.commands.subarray(at + 2 * robot, at + 2 * robot + 2));
  fleet.step();
  for (let robot = 0; robot < given.count; robot++)
    qpos.push(...fleet.robots.numbers("qpos", robot));
}
const trainer = new Trainer(engine, 0), before = trainer.arrays.params.view.slice();
trainer.step();
return { qpos: Float32Array.from(qpos), poses: fleet.poses(), goals: fleet.goals(),
  before, after: trainer.arrays.params.view };
"""


def linked_page(folder, config):
    """The page of a policy that nobody trained."""
    if reason := wasm.obstacle():
        pytest.skip(reason)
    write_untrained_run(folder, config)
    return page_of(load_checkpoint(folder))


@pytest.mark.cpu
@pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels for this CPU")
@pytest.mark.slow
@pytest.mark.parametrize("name", OWN)
def test_robots_and_tasks_of_ones_own_drive_and_learn(name, root, tmp_path):
    page = linked_page(tmp_path / name, load_config(root / "examples" / f"{name}.yaml", SMALL))
    env, meta = page.env, page.data["meta"]
    rng = np.random.default_rng(0)
    # Each command is given for a while, from one end to the other.
    commands = rng.choice(np.float32([-1, 1]), size=(STEPS // 15, ROBOTS, 2)).repeat(15, axis=0)
    keys = np.asarray(report_keys(ROBOTS))
    found = page.run(DRIVE, keys=keys.ravel(), commands=commands.ravel(), count=ROBOTS)
    one = NewEpisodeWrapper(EpisodeWrapper(env.blind(), env.config.task.episode_length))
    robots = BatchWrapper(KernelWrapper(one))

    @jax.jit
    def run(keys, commands):
        def step(state, action):
            state = robots.step(state, action)
            return state, state.pipeline_state.qpos

        end, qpos = jax.lax.scan(step, robots.reset(keys), commands)
        goals, markers = (jax.vmap(f)(end.goal) for f in (env.task.goal_position, env.task.markers))
        return qpos, goals, markers["goal"]

    theirs, goals, cubes = jax.device_get(run(keys, commands))
    ours = found["qpos"].reshape(theirs.shape)
    assert np.ptp(theirs[..., :2], axis=0).max() > 0.3
    np.testing.assert_allclose(ours[..., :3], theirs[..., :3], rtol=0, atol=1e-4)
    np.testing.assert_allclose(found["goals"].reshape(goals.shape), goals, rtol=0, atol=1e-5)
    # Everything that is drawn has a pose; the goal's cube may be below the floor.
    poses = found["poses"].reshape(ROBOTS, meta["scene"]["bodies"], 7)
    assert np.isfinite(poses).all()
    assert {geom["body"] for geom in meta["scene"]["geoms"]} == {*range(meta["scene"]["bodies"])}
    np.testing.assert_allclose(poses[:, meta["scene"]["goal"], :3], cubes, rtol=0, atol=1e-5)
    # A training step changes the parameters, and leaves numbers.
    assert np.isfinite(found["after"]).all()
    assert np.abs(found["after"] - found["before"]).max() > 1e-5


PLAIN = """
from jetbot_mjx.envs import GoalTask

class PlainTask(GoalTask):
    def success(self, robot, goal):
        return self.distance(robot, goal) < float(self.config.success_radius)
"""

CALLING = """
import jax
import numpy as np
from jetbot_mjx.envs import GoalTask

class CallingTask(GoalTask):
    def reward(self, *given, **others):
        reward, terms = super().reward(*given, **others)
        like = jax.ShapeDtypeStruct((), np.float32)
        return jax.pure_callback(np.asarray, like, reward, vmap_method="sequential"), terms
"""


REMEMBERING = """
import jax.numpy as jnp
from typing import NamedTuple
from jetbot_mjx.envs import GoalTask

class Place(NamedTuple):
    position: jnp.ndarray
    seen: jnp.ndarray

class RememberingTask(GoalTask):
    def sample(self, key):
        return Place(super().sample(key), jnp.zeros(3, bool))

    def goal_position(self, goal):
        return goal.position

    def move_goal(self, goal, position_w):
        return goal._replace(position=position_w)
"""


FIXED = """
import jax.numpy as jnp
from typing import NamedTuple
from jetbot_mjx.envs import GoalTask

class Place(NamedTuple):
    position: jnp.ndarray
    radius: jnp.ndarray

class FixedTask(GoalTask):
    def sample(self, key):
        return Place(super().sample(key), jnp.float32(0.1))

    def goal_position(self, goal):
        return goal.position
"""


def own_task(folder, source, name):
    """The configuration of a task that is written beside it."""
    (folder / f"{name.lower()}_of_mine.py").write_text(source)
    (folder / "mine.yaml").write_text(f"task: {{name: '{name.lower()}_of_mine:{name}'}}\n")
    return load_config(folder / "mine.yaml", SMALL)


@pytest.mark.slow
def test_a_task_that_reads_its_settings_as_plain_numbers_has_no_knobs(tmp_path):
    page = linked_page(tmp_path / "run", own_task(tmp_path, PLAIN, "PlainTask"))
    assert page.data["meta"]["robot_functions"]["knobs"] == []
    body = """
    const fleet = engine.fleet(64, 0);
    fleet.scripted = true;
    for (let step = 0; step < 300; step++) fleet.step();
    return [fleet.episodes, fleet.successes];
    """
    episodes, successes = page.run(body)
    assert episodes >= 64
    assert successes > 0.9 * episodes


@pytest.mark.slow
def test_a_goal_that_its_task_cannot_move_stays(tmp_path):
    # The task inherits a `move_goal` for goals that are positions.
    page = linked_page(tmp_path / "run", own_task(tmp_path, FIXED, "FixedTask"))
    assert "move" not in page.data["meta"]["robot_functions"]["functions"]
    body = """
    const fleet = engine.fleet(9, 0), before = fleet.goals().slice();
    fleet.setGoal(4, 1, 1);
    return { before, after: fleet.goals() };
    """
    found = page.run(body)
    np.testing.assert_array_equal(found["after"], found["before"])
    assert np.ptp(found["before"]) > 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "name", "reason"),
    [
        (CALLING, "CallingTask", "pure_callback"),
        (REMEMBERING, "RememberingTask", "numbers of bool: make them int32 or float32"),
    ],
)
def test_a_task_that_is_no_kernel_is_an_error_of_one_line(source, name, reason, tmp_path):
    write_untrained_run(tmp_path / "run", own_task(tmp_path, source, name))
    with pytest.raises(UserError) as caught:
        page_data(load_checkpoint(tmp_path / "run"))
    message = str(caught.value)
    assert message.startswith("no page of run: ")
    assert reason in message
    assert len(message.splitlines()) == 1
