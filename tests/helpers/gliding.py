"""A robot that glides: it moves as it is told, and MJX, which takes long to compile, has no part.

For tests of what does not ask how a robot moves: trainers, signals, kills, devices. All else of
the environment stays as it is. As a program it is one of the package's commands on that robot:
`[sys.executable, *program("train"), "--config", …]`.
"""

import contextlib
import importlib
import sys
from unittest import mock

import jax.numpy as jnp

from helpers import motion
from jetbot_mjx import cli
from jetbot_mjx.config import RobotConfig
from jetbot_mjx.envs import kinematics, program_key
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.mujoco_simulator import MujocoPhysics
from jetbot_mjx.envs.physics import Physics
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QPOS_XYZ, QVEL_ANGULAR_B, QVEL_LINEAR_W

ISAAC = RobotConfig(preset="isaac")

LAG = 0.1  # [s] of the motors, so that there is something to learn


class GlidingPhysics(Physics):
    def step(self, state, ctrl, mocap_pos=None):
        dt = self._config.ctrl_dt
        wanted = motion.body_twist(
            ctrl,
            wheel_radius=ISAAC.controller_wheel_radius,
            wheel_separation=ISAAC.controller_wheel_separation,
        )
        heading = kinematics.yaw(state.qpos[QPOS_QUAT])
        ahead_w = jnp.stack([jnp.cos(heading), jnp.sin(heading), 0.0])
        twist = jnp.stack([state.qvel[QVEL_LINEAR_W] @ ahead_w, state.qvel[QVEL_ANGULAR_B][2]])
        speed, yaw_rate = twist + dt / LAG * (wanted - twist)
        half = 0.5 * (heading + dt * yaw_rate)
        quat = jnp.stack([jnp.cos(half), 0.0, 0.0, jnp.sin(half)])
        qpos = state.qpos.at[QPOS_XYZ].add(dt * speed * ahead_w).at[QPOS_QUAT].set(quat)
        qvel = state.qvel.at[QVEL_LINEAR_W].set(speed * ahead_w)
        qvel = qvel.at[QVEL_ANGULAR_B].set(jnp.stack([0.0, 0.0, yaw_rate]))
        return state.replace(qpos=qpos, qvel=qvel, time=state.time + dt)


class Gliding(JetBotEnv):
    physics_class = GlidingPhysics

    def __init__(self, *given):
        super().__init__(*given)
        self.physics = self.physics_class(self.physics.mj_model, self.config.physics)


@contextlib.contextmanager
def everywhere():
    """A context within which every robot of this process glides, and no program is kept."""
    with (
        mock.patch.object(Physics, "step", GlidingPhysics.step),
        mock.patch.object(MujocoPhysics, "step", GlidingPhysics.step),
        mock.patch.object(program_key, "BUILT_IN_TASKS", frozenset()),
    ):
        yield


def program(command):
    """Arguments of Python for one of the package's commands, on a robot that glides."""
    return ["-c", f"{LAZILY}; from helpers import gliding; gliding.main()", command]


LAZILY = "from jetbot_mjx.startup import install_lazy_imports; install_lazy_imports()"
"""What a process runs first, to import as little as the commands do, which takes half the time."""


def main():
    """Runs the command that the first argument names."""
    command = importlib.import_module(f"jetbot_mjx.{sys.argv.pop(1)}")
    with everywhere():
        cli.run_command(command.main, at_once=command.__name__.endswith(".train"))
