"""One robot that drives live, behind any viewer: its episodes, its clock, and what to show.

Episodes are those of a training: a goal is drawn, and the next one when it is reached, when the
time limit is, or when the task ends the episode otherwise. All of it follows from one seed. A
player is not safe to call from several threads.
"""

import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, UInt32

from jetbot_mjx.envs.robot_model import QPOS_XYZ
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint import Checkpoint, Which, load_checkpoint
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps
from jetbot_mjx.viewers.realtime import Clock, Rate
from jetbot_mjx.viewers.step_fns import AGENTS, Inputs, Shown, make_programs, why_goals_stay

SPEEDS = (0.1, 4.0)
"""Slowest and fastest pace, as a multiple of real time."""

_NUDGES = 8  # from standing to as fast as it goes
_HOLD_SECONDS = 0.4  # of standing still after the end, so that the eye sees it


class Player:
    """Drives one robot with a policy of a run, a baseline, or what the user asks for."""

    def __init__(
        self,
        run_or_checkpoint: str | Path,
        *,
        which: Which = "best",
        agent: str = "policy",
        seed: int = 0,
    ) -> None:
        """Load the policy, compiles what all agents share, and draws a goal.

        Args:
          run_or_checkpoint: a run folder, or one checkpoint folder of it.
          which: the checkpoint of a run folder.
          agent: one of `AGENTS`.
          seed: of goals and of the random agent.

        Raises:
          UserError: there is no usable checkpoint, its task cannot be built, or the agent is none.
        """
        self.agent = agent
        checkpoint = load_checkpoint(run_or_checkpoint, which)
        self.env = checkpoint.make_env()
        self.run_dir = checkpoint.run_dir
        self.paused = False
        self.successes = 0
        """Episodes that ended with success."""
        self.episodes = 0
        """Episodes that ended; one that the user broke off is none."""
        self.outcome: str | None = None
        """How the last episode ended; None before."""
        self.frames = Rate()
        """Of the viewer: it notes each picture that it hands out."""
        # One robot is faster on a CPU than on the GPU that may stand beside it.
        self._device = _cpu()
        self._programs = make_programs(self.env, checkpoint.networks)
        self._key, key = self._put(tuple(jax.random.split(jax.random.PRNGKey(seed))))
        self._count = 0
        self._rate = Rate()
        self._speed = 1.0
        self.drive(0.0, 0.0)
        self._take(checkpoint)
        self._begin(key)
        self.cannot_move_goal = why_goals_stay(self.env, self._state)
        """Why `move_goal` does nothing, in one line; empty where it moves the goal."""
        self._programs.step(self._state, self._inputs())
        self._restart_clock()

    def tick(self) -> None:
        """Make one control step; after an episode's end the robot stands still for a moment."""
        self._count += 1
        if self._hold > 0:
            self._hold -= 1
            if self._hold == 0:
                self.reset()
            return
        self._state, shown = self._programs.step(self._state, self._inputs())
        self._show(shown)
        if self.shown.done > 0:
            self.episodes += 1
            self.successes += int(self.shown.success)
            self.outcome = _outcome(self.shown)
            self._hold = round(_HOLD_SECONDS / self.env.dt)

    def advance(self) -> int:
        """Take the steps that are due in real time, none while paused.

        Returns:
          How many.
        """
        if self.paused:
            self._restart_clock()
            return 0
        steps = self._clock.due(time.monotonic())
        for _ in range(steps):
            self.tick()
        self._rate.count(time.monotonic(), steps)
        return steps

    def wait(self) -> float:
        """Return how long until the next step is due [s]."""
        return self._clock.wait(time.monotonic())

    def reset(self) -> None:
        """Begin the next episode: the robot at the origin, a new goal."""
        self._begin(self._state.key)

    def move_goal(self, x: float, y: float) -> bool:
        """Put the goal elsewhere on the floor; the time limit begins anew.

        Args:
          x: world frame [m].
          y: world frame [m].

        Returns:
          Whether the task can; `cannot_move_goal` says why not.
        """
        if self.cannot_move_goal:
            return False
        position_w = np.array([x, y, self.shown.goal_w[2]], np.float32)
        self._state, shown = self._programs.move(self._state, position_w)
        self._show(shown)
        self._hold = 0
        return True

    def switch_checkpoint(self, env_steps: int) -> None:
        """Let another checkpoint of the run drive on from here.

        Args:
          env_steps: by which it is named.

        Raises:
          CheckpointError: it is not there or cannot be used; the one before drives on.
        """
        self._take(load_checkpoint(self.run_dir, env_steps))

    def drive(self, speed: float, yaw_rate: float) -> None:
        """Return what the user asks of the robot while the agent is `keyboard`; held until changed.

        Args:
          speed: forward [m/s], clipped to what an action can ask for.
          yaw_rate: to the left [rad/s], clipped likewise.
        """
        limits = self.env.config.task
        self.asked = (
            float(np.clip(speed, 0.0, limits.max_speed)),
            float(np.clip(yaw_rate, -limits.max_yaw_rate, limits.max_yaw_rate)),
        )
        """Speed [m/s] and yaw rate [rad/s] that are asked for."""

    def nudge(self, ahead: int, left: int) -> None:
        """Ask for a little more than before: one press of a key.

        Args:
          ahead: 1 faster, -1 slower.
          left: 1 more to the left, -1 to the right; against a turn, the first only ends it.
        """
        speed, yaw_rate = self.asked
        limits = self.env.config.task
        turn = left * limits.max_yaw_rate / _NUDGES
        yaw_rate = 0.0 if turn * yaw_rate < 0 else yaw_rate + turn
        self.drive(speed + ahead * limits.max_speed / _NUDGES, yaw_rate)

    @property
    def agent(self) -> str:
        """Return who drives, one of `AGENTS`."""
        return AGENTS[self._agent]

    @agent.setter
    def agent(self, name: str) -> None:
        if name not in AGENTS:
            raise UserError(f"--agent {name!r} is none: choose from {', '.join(AGENTS)}")
        self._agent = AGENTS.index(name)

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
        """Environment steps of the run's checkpoints, those written meanwhile included."""
        return sorted({*checkpoint_steps(self.run_dir), self.checkpoint})

    @property
    def time(self) -> float:
        """Since the episode began, or its goal was moved [s]."""
        return float(self.shown.steps) * self.env.dt

    @property
    def time_limit(self) -> float:
        """After which an episode is cut off [s]."""
        return self.env.config.task.episode_length * self.env.dt

    @property
    def distance(self) -> float:
        """From the axle's midpoint to the goal, on the floor [m]."""
        offset = self.shown.goal_w - self.shown.qpos[QPOS_XYZ]
        return float(np.hypot(offset[0], offset[1]))

    @property
    def steps_per_second(self) -> float:
        """Control steps of the last second, those of standing still included [1/s]."""
        return self._rate.per_second(time.monotonic())

    @property
    def frames_per_second(self) -> float:
        """Return how many frames the viewer handed out within the last second [1/s]."""
        return self.frames.per_second(time.monotonic())

    def _take(self, checkpoint: Checkpoint) -> None:
        self._params = self._put(checkpoint.params)
        self.checkpoint = checkpoint.env_steps
        """Environment steps of the policy that drives."""

    def _inputs(self) -> Inputs:
        return Inputs(
            agent=np.int32(self._agent),
            params=self._params,
            twist_b=np.array(self.asked, np.float32),
            key=self._key,
            count=np.uint32(self._count),
        )

    def _begin(self, key: UInt32[Array, "2"]) -> None:
        self._state, shown = self._programs.reset(key)
        self._show(shown)
        self._hold = 0

    def _show(self, shown: Shown) -> None:
        self.shown: Shown = jax.device_get(shown)
        """What the viewer shows."""

    def _put(self, tree: Any) -> Any:
        return jax.device_put(tree, self._device)

    def _restart_clock(self) -> None:
        self._clock = Clock(self.env.dt / self._speed, time.monotonic())


def _outcome(shown: Shown) -> str:
    if shown.success > 0:
        return "reached"
    if shown.nonfinite > 0:
        return "world blew up"
    return "failed" if shown.terminated > 0 else "out of time"


def _cpu() -> Any:
    try:
        return jax.devices("cpu")[0]
    except RuntimeError:
        # `JAX_PLATFORMS` leaves it out.
        return jax.devices()[0]
