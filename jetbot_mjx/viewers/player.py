"""Simulate one robot or many in real time, for any viewer.

Episodes follow the rules of training: a new goal is drawn when the task or the time limit ends an
episode. One seed determines all goals. Robots do not see one another: each is alone in its own
world. A player is not thread-safe.
"""

import operator
import time
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jetbot_mjx.devices import host_cpu
from jetbot_mjx.envs import QPOS_XYZ, State
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Checkpoint, Which, checkpoint_steps, load_checkpoint
from jetbot_mjx.viewers.realtime import Clock, Rate
from jetbot_mjx.viewers.step_fns import AGENTS, Inputs, Snapshot, make_viewer_fns, move_goal_error

SPEEDS = (0.1, 4.0)
"""Slowest and fastest pace, as a multiple of real time."""

_Tree = TypeVar("_Tree")

_NUDGES = 8  # key presses from standstill to the largest command
_HOLD_SECONDS = 0.4  # pause after the end of an episode, so that the user sees it


class Player:
    """A `Player` drives robots with a policy of a run, a baseline, or commands of the user.

    One of the robots is chosen: `snapshot`, `time`, `distance` and `move_goal` are about it.
    """

    def __init__(
        self,
        run_or_checkpoint: str | Path,
        *,
        which: Which = "best",
        agent: str = "policy",
        seed: int = 0,
        robots: int = 1,
    ) -> None:
        """Load the policy, compile the functions that all agents share, and begin an episode.

        Args:
          run_or_checkpoint: a run folder, or one checkpoint folder of it.
          which: the checkpoint of a run folder.
          agent: one of `AGENTS`.
          seed: the seed of the goals and of the random agent.
          robots: the number of robots, which drive in one compiled step.

        Raises:
          UserError: there is no usable checkpoint, its task cannot be built, or there is no such
            agent.
        """
        if agent not in AGENTS:
            raise UserError(f"--agent {agent!r} is unknown: choose from {', '.join(AGENTS)}")
        self.agent = agent
        """The agent that drives, one of `AGENTS`."""
        checkpoint = load_checkpoint(run_or_checkpoint, which)
        self.env = checkpoint.make_setup().robot_env
        self.run_dir = checkpoint.run_dir
        self.paused = False
        self.successes = 0
        """Number of episodes of all robots that ended with success."""
        self.episodes = 0
        """Number of episodes of all robots that ended, without those that the user reset."""
        self.outcome: str | None = None
        """How the last episode ended, in words; None before the first end."""
        self.robots = robots
        """Number of robots."""
        self.ticks, self.frames = Rate(), Rate()
        """Counters of control steps, pauses included, and of the frames that the viewer shows."""
        # A few robots are faster on a CPU than on a GPU.
        self._device = host_cpu()
        self._fns = make_viewer_fns(self.env, checkpoint.networks)
        self._key, key = self._put(tuple(jax.random.split(jax.random.PRNGKey(seed))))
        # The first robot's goals do not depend on the number of robots.
        keys = [key, *(jax.random.fold_in(key, robot) for robot in range(1, robots))]
        self._count, self._speed = 0, 1.0
        self.drive(0.0, 0.0)
        self._use(checkpoint)
        self._hold = np.zeros(robots, int)
        self.robot = 0
        """Index of the chosen robot."""
        self._set(self._fns.reset(self._put(jnp.stack(keys))))
        one = jax.tree.map(operator.itemgetter(0), self._states)
        self.cannot_move_goal = move_goal_error(self.env, one)
        """Why `move_goal` does nothing, in one line; empty if it moves the goal."""
        # Compile now what the first episodes will need.
        self._fns.step(self._states, self._inputs())
        self._fns.restart(self._states, self._hold > 0)
        self._restart_clock()

    def tick(self) -> None:
        """Make one control step; after the end of an episode a robot pauses for a moment."""
        self._count += 1
        standing = self._hold > 0
        if not standing.all():
            self._set(self._fns.step(self._states, self._inputs()))
            ended = (self.crowd.done > 0) & ~standing
            self.episodes += int(ended.sum())
            self.successes += int(self.crowd.success[ended].sum())
            self._hold[ended] = round(_HOLD_SECONDS / self.env.dt)
            if ended[self.robot]:
                self.outcome = _outcome(self.snapshot)
        self._hold[standing] -= 1
        over = standing & (self._hold == 0)
        if over.any():
            self._set(self._fns.restart(self._states, over))

    def advance(self) -> int:
        """Make the control steps that are due in real time, none while paused.

        Returns:
          The number of steps made.
        """
        if self.paused:
            self._restart_clock()
            return 0
        steps = self._clock.due(time.monotonic())
        for _ in range(steps):
            self.tick()
        self.ticks.count(time.monotonic(), steps)
        return steps

    def wait(self) -> float:
        """Return the time until the next step is due [s]."""
        return self._clock.wait(time.monotonic())

    def reset(self) -> None:
        """Begin the next episode of all robots: each is at its origin, and new goals are drawn."""
        self._hold[:] = 0
        self._set(self._fns.restart(self._states, np.ones(self.robots, bool)))

    def move_goal(self, x: float, y: float) -> bool:
        """Move the chosen robot's goal on the floor and restart its time limit.

        Args:
          x: the position along the world's x axis [m].
          y: the position along the world's y axis [m].

        Returns:
          Whether the task supports it; `cannot_move_goal` has the reason if not.
        """
        if self.cannot_move_goal:
            return False
        position_w = np.array([x, y, self.snapshot.goal_w[2]], np.float32)
        self._hold[self.robot] = 0
        self._set(self._fns.move(self._states, np.int32(self.robot), position_w))
        return True

    def switch_checkpoint(self, env_steps: int) -> None:
        """Continue with the policy of another checkpoint of the run.

        Args:
          env_steps: the environment steps of the checkpoint.

        Raises:
          CheckpointError: there is no such checkpoint, or it cannot be used; the policy stays.
        """
        self._use(load_checkpoint(self.run_dir, env_steps))

    def drive(self, speed: float, yaw_rate: float) -> None:
        """Set the command of the agent `keyboard`; it holds until the next call.

        Args:
          speed: forward speed [m/s], clipped to what an action can command.
          yaw_rate: yaw rate [rad/s], positive to the left, clipped likewise.
        """
        limits = self.env.config.task
        self.command = (
            float(np.clip(speed, 0.0, limits.max_speed)),
            float(np.clip(yaw_rate, -limits.max_yaw_rate, limits.max_yaw_rate)),
        )
        """Command of the agent `keyboard`: forward speed [m/s] and yaw rate [rad/s]."""

    def nudge(self, ahead: int, left: int) -> None:
        """Change the command of the agent `keyboard` by one press of a key.

        Args:
          ahead: 1 for faster, -1 for slower, or 0.
          left: 1 for left, -1 for right, or 0. A press against the present turn only stops it.
        """
        speed, yaw_rate = self.command
        limits = self.env.config.task
        turn = left * limits.max_yaw_rate / _NUDGES
        yaw_rate = 0.0 if turn * yaw_rate < 0 else yaw_rate + turn
        self.drive(speed + ahead * limits.max_speed / _NUDGES, yaw_rate)

    @property
    def snapshot(self) -> Snapshot:
        """Return what a viewer shows of the last step of the chosen robot, on the host."""
        return jax.tree.map(operator.itemgetter(self.robot), self.crowd)

    @property
    def speed(self) -> float:
        """Pace as a multiple of real time, within `SPEEDS`."""
        return self._speed

    @speed.setter
    def speed(self, value: float) -> None:
        self._speed = min(max(value, SPEEDS[0]), SPEEDS[1])
        self._restart_clock()

    @property
    def checkpoints(self) -> list[int]:
        """Environment steps of the run's checkpoints, including new ones of a running training."""
        return sorted({*checkpoint_steps(self.run_dir), self.checkpoint})

    @property
    def time(self) -> float:
        """Simulated time since the episode began or its goal was moved [s]."""
        return float(self.snapshot.steps) * self.env.dt

    @property
    def distance(self) -> float:
        """Horizontal distance from the axle midpoint to the goal [m]."""
        offset = self.snapshot.goal_w - self.snapshot.qpos[QPOS_XYZ]
        return float(np.hypot(offset[0], offset[1]))

    @property
    def sees(self) -> bool:
        """Return whether the policy sees through the robot's camera."""
        return self.env.camera is not None

    def image(self) -> UInt8[np.ndarray, "h w c"]:
        """Return the newest image of the chosen robot's camera; only if the policy sees."""
        return np.asarray(self._fns.see(self._states, np.int32(self.robot)))

    def occlusion_map(self) -> Float[np.ndarray, "h w"]:
        """Return how far the policy's action changes if a pixel of that image is covered.

        The policy is that of the checkpoint, whoever drives; `evaluation.occlusion` explains it.
        """
        return np.asarray(self._fns.occlusion(self._states, np.int32(self.robot), self._params))

    def describe(self) -> dict[str, str]:
        """Return the texts that a viewer shows about the chosen robot and the pace, by label."""
        ended = f", {self.outcome}" if self.snapshot.done else ""
        limit, now = self.env.config.task.episode_length * self.env.dt, time.monotonic()
        steps, frames = self.ticks.per_second(now), self.frames.per_second(now)
        return {
            "Goals": f"{self.successes} of {self.episodes} reached",
            "Episode": f"{self.time:.1f} of {limit:.1f} s{ended}",
            "Distance": f"{self.distance:.2f} m",
            "Pace": f"{steps:.0f} steps/s, {frames:.0f} frames/s",
        }

    def _use(self, checkpoint: Checkpoint) -> None:
        self._params = self._put(checkpoint.params)
        self.checkpoint = checkpoint.env_steps
        """Environment steps of the current checkpoint."""

    def _inputs(self) -> Inputs:
        return Inputs(
            agent=np.int32(AGENTS.index(self.agent)),
            params=self._params,
            twist_b=np.array(self.command, np.float32),
            key=self._key,
            count=np.uint32(self._count),
            standing=self._hold > 0,
        )

    def _set(self, result: tuple[State, Snapshot]) -> None:
        self._states = result[0]
        self.crowd: Snapshot = jax.device_get(result[1])
        """The same of all robots."""

    def _put(self, tree: _Tree) -> _Tree:
        return jax.device_put(tree, self._device)

    def _restart_clock(self) -> None:
        self._clock = Clock(self.env.dt / self._speed, time.monotonic())


def _outcome(snapshot: Snapshot) -> str:
    """Describe in words how an episode ended."""
    if snapshot.success > 0:
        return "reached"
    if snapshot.nonfinite > 0:
        return "non-finite state"
    return "failed" if snapshot.terminated > 0 else "out of time"
