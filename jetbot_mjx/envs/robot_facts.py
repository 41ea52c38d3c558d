"""Tell what a robot is, how it follows its commands, and how fast it is simulated."""

import math
import time
from collections.abc import Iterator
from typing import Any

import jax

from jetbot_mjx.config import MjcfRobotConfig
from jetbot_mjx.envs.drive import AckermannDrive, OwnDrive
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_trial import drive_trial
from jetbot_mjx.envs.task import reach_on_floor

_STEPS = 64
"""Steps of a call whose rate is measured."""

_WELL = 0.05
"""Largest share by which a robot may turn less or more than it is told, without a hint."""


def describe_robot(env: JetBotEnv) -> Iterator[tuple[str, str]]:
    """Yield what the robot is, and how it follows its commands, as a label and a text each.

    Args:
      env: one environment, unwrapped.
    """
    config, drive, model = env.config, env.drive, env.physics.mj_model
    mass = float(model.body_subtreemass[model.jnt_bodyid[0]])
    height = float(model.qpos0[2])
    yield "robot", f"{env.robot.label}: {mass:.3g} kg, its body {1e3 * height:.3g} mm up at rest"
    trial = drive_trial(config, model, drive)
    if trial is None or isinstance(drive, OwnDrive):
        yield "drive", f"{drive.action_size} numbers, by a function of its own"
        return
    top = config.task.max_speed
    speed = trial.speed * top
    yield "speed", f"{speed:.3g} m/s of task.max_speed = {top:g}"
    if isinstance(drive, AckermannDrive):
        curvature = trial.turn * drive.max_curvature
        yield "turn", f"circles of {1.0 / curvature:.3g} m"
        yield from _goals(env, speed, speed * curvature)
        return
    wheels = f"wheels of {1e3 * drive.wheel_radius:.3g} mm"
    yield "wheels", f"{wheels}, {1e3 * drive.wheel_separation:.3g} mm apart for the controller"
    yield "turn", f"{trial.turn:.0%} of the yaw rate that is commanded"
    if trial.turn > _WELL and abs(trial.turn - 1.0) > _WELL:
        key = "controller_wheel_separation"
        if isinstance(env.robot, MjcfRobotConfig):
            key = "wheel_separation"
        fits = drive.wheel_separation / trial.turn
        yield "", f"robot.{key} = {fits:.2g} would make that 100 %"
    yield from _goals(env, speed, trial.turn * drive.max_yaw_rate)


def _goals(env: JetBotEnv, speed: float, yaw_rate: float) -> Iterator[tuple[str, str]]:
    """Yield how long the farthest goal takes, unless the task has goals of its own.

    Args:
      env: one environment, unwrapped.
      speed: the largest speed [m/s].
      yaw_rate: the largest yaw rate [rad/s].
    """
    task = env.config.task
    reach = reach_on_floor(env.task, float(env.mj_model.qpos0[2]))
    if reach is None:
        return
    farthest = task.goal_distance_min + task.goal_distance_span
    seconds, limit = (farthest - reach) / speed + math.pi / yaw_rate, task.episode_length * env.dt
    yield "goals", f"reached within {1e3 * reach:.3g} mm on the floor"
    yield "", f"{farthest:g} m to the rear takes {seconds:.2g} s, an episode {limit:.2g} s"
    if seconds > limit:
        steps = math.ceil(1.25 * seconds / env.dt / 64) * 64
        yield "", f"task.episode_length = {steps} would be enough"


def step_rate(env: JetBotEnv, robots: int) -> float:
    """Return the environment steps per second of many robots on JAX's default device.

    Args:
      env: one environment, unwrapped; its images are left out.
      robots: the number of robots.
    """
    one = env.blind()
    keys = jax.random.split(jax.random.PRNGKey(0), robots)
    states = jax.jit(jax.vmap(one.reset))(keys)
    actions = jax.random.uniform(keys[0], (robots, env.action_size), minval=-1.0)

    @jax.jit
    def drive(states: Any) -> Any:
        step = jax.vmap(one.step)
        return jax.lax.fori_loop(0, _STEPS, lambda _, x: step(x, actions), states)

    jax.block_until_ready(drive(states))
    begin = time.perf_counter()
    jax.block_until_ready(drive(states))
    return robots * _STEPS / (time.perf_counter() - begin)
