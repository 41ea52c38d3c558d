"""Tasks that are each wrong in one way, for `check_env` to find out."""

import itertools
import random
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jetbot_mjx.envs.task import Field, GoalTask

count = itertools.count()


class TwoOfAName(GoalTask):
    def __init__(self, config):
        super().__init__(config)
        self.layout = (*self.layout[:-1], Field("position", 3, "m", "world"))


class NoUnit(GoalTask):
    def __init__(self, config):
        super().__init__(config)
        self.layout = (*self.layout[:-1], Field("goal_position", 3, "", "world"))


class NoScale(GoalTask):
    def __init__(self, config):
        super().__init__(config)
        self.layout = (*self.layout, Field("battery", 1, "V", "body"))


class NegativeScale(GoalTask):
    def __init__(self, config):
        super().__init__(config)
        self.layout = (*self.layout[:-1], self.layout[-1]._replace(min_std=-0.1))


class LongerThanItsLayout(GoalTask):
    def observe(self, robot, goal):
        return jnp.append(super().observe(robot, goal), 0.0)


class DecidesInPython(GoalTask):
    def success(self, robot, goal):
        if self.distance(robot, goal) < 0.1:
            return jnp.bool_(True)
        return jnp.bool_(False)


class Raises(GoalTask):
    def observe(self, robot, goal):
        raise KeyError("lidar")


class CannotBeBuilt(GoalTask):
    def __init__(self, config):
        super().__init__(config)
        self.layout = self.layout[99]


class DrawsFromPython(GoalTask):
    def sample(self, key):
        return super().sample(key) * jnp.float32(random.random())


class KeepsWhatItSaw(GoalTask):
    seen = 0

    def reward(self, before, after, goal, action):
        self.seen = after.position_w
        return super().reward(before, after, goal, action)


class WeaklyTyped(GoalTask):
    def reward(self, before, after, goal, action):
        done = 2.0 * self.success(after, goal)
        return done, {"done": done}


class NumberForTruth(GoalTask):
    def terminated(self, robot, goal):
        return self.success(robot, goal).astype(jnp.float32)


class NoTerms(GoalTask):
    def reward(self, before, after, goal, action):
        return super().reward(before, after, goal, action)[0]


class SameEveryTime(GoalTask):
    def sample(self, key):
        return jnp.array([0.5, 0.5, 0.05])


class AsksTheHost(GoalTask):
    """One robot's distance becomes that of all, where all are asked at once."""

    def distance(self, robot, goal):
        nearest = lambda x: np.full_like(x, np.min(x))  # noqa: E731
        distance = super().distance(robot, goal)
        return jax.pure_callback(nearest, distance, distance, vmap_method="expand_dims")


class DividesByZero(GoalTask):
    def reward(self, before, after, goal, action):
        away = goal[:2] - after.position_w[:2]
        towards = (away / jnp.linalg.norm(away)).sum()
        return towards, {"towards": towards}


class OverflowsFarAway(GoalTask):
    def reward(self, before, after, goal, action):
        near = jnp.exp(jnp.square(after.linear_velocity_w).sum())
        return near, {"near": near}


class HidesAPenalty(GoalTask):
    def reward(self, before, after, goal, action):
        reward, terms = super().reward(before, after, goal, action)
        return reward - 0.01 * jnp.square(action).sum(), terms


class SucceedsOnAndOn(GoalTask):
    def terminated(self, robot, goal):
        return self.distance(robot, goal) > 1e6


class EndsWhereItBegins(GoalTask):
    def success(self, robot, goal):
        return self.distance(robot, goal) < 0.6


class Drawn(NamedTuple):
    goal_w: jax.Array
    colour: jax.Array


class InheritsMoveGoal(GoalTask):
    def sample(self, key):
        return Drawn(super().sample(key), jnp.float32(0.5))

    def goal_position(self, goal):
        return goal.goal_w


class ForgetsWhereItMoved(GoalTask):
    def move_goal(self, goal, position_w):
        return goal


class ChangesTheTree(GoalTask):
    def advance(self, before, after, goal):
        return goal.astype(jnp.int32)


class MarksNobody(GoalTask):
    def markers(self, goal):
        return {**super().markers(goal), "flag": goal}


class LeavesItSolid(GoalTask):
    def build_scene(self, spec):
        spec.worldbody.add_geom(
            name="wall", size=(0.1, 0.1, 0.1), type=mujoco.mjtGeom.mjGEOM_BOX, contype=1
        )


class StandsOnTheRobot(GoalTask):
    def build_scene(self, spec):
        spec.worldbody.add_geom(
            name="ball", size=(0.05, 0, 0), pos=(0.0, 0.1, 0.05), type=mujoco.mjtGeom.mjGEOM_SPHERE
        )
        spec.add_pair(geomname1="ball", geomname2="left_wheel", condim=1)


class AsksForAnotherSolver(GoalTask):
    def build_scene(self, spec):
        spec.option.solver = mujoco.mjtSolver.mjSOL_PGS


class NamesNoSite(GoalTask):
    def build_scene(self, spec):
        tendon = spec.add_tendon(name="rope")
        tendon.wrap_site("nowhere")


class PutsItOnTheRobot(GoalTask):
    def build_scene(self, spec):
        pillar = spec.worldbody.add_body(name="pillar", mocap=True, pos=(1.0, 0.0, 0.0))
        pillar.add_geom(name="pillar", size=(0.05, 0, 0), type=mujoco.mjtGeom.mjGEOM_SPHERE)
        spec.add_pair(geomname1="pillar", geomname2="left_wheel", condim=1)

    def markers(self, goal):
        return {**super().markers(goal), "pillar": jnp.array([0.0, 0.1, 0.05])}


class NamesATermAnewEachTime(GoalTask):
    def reward(self, before, after, goal, action):
        reward, _ = super().reward(before, after, goal, action)
        return reward, {f"progress_{next(count)}": reward}


class Sound(GoalTask):
    """Nothing is wrong with this one."""
