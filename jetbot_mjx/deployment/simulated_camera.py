"""Simulate the robot's camera for a driver: pictures of MuJoCo's renderer, late, noisy, some lost.

A `SimulatedCamera` has what a driver reads of NVIDIA's `jetbot.Camera`: `value`, the newest
picture, uint8, blue, green, red. It looks from a `SimulatedJetBot`, on that robot's clock.
"""

import collections
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jetbot_mjx.config import CameraConfig, PhysicsConfig, RobotConfig
from jetbot_mjx.deployment.simulated_jetbot import SimulatedJetBot
from jetbot_mjx.envs import GOAL_HEIGHT, MujocoCamera, SceneryKind, make_mj_model
from jetbot_mjx.runs import JsonObject

SIDE = 224
"""Width and height of a picture [pixels], as of NVIDIA's camera."""

_HIDDEN = (0.0, 0.0, -1.0)  # [m] below the floor

_Picture = UInt8[np.ndarray, "h w 3"]

Fault = Literal["frozen", "black", "missing"]


class CameraModel(NamedTuple):
    """A `CameraModel` holds what happens between the light and the driver."""

    latency: float = 0.08
    """Time from the light to the driver [s]."""
    rate: float = 20.0
    """Pictures per second."""
    dropped: float = 0.05
    """Share of the pictures that are lost."""
    noise: int = 4
    """Largest noise of a channel, from 0 to 255; every value up to it is equally likely."""


def camera_config(image: JsonObject) -> CameraConfig:
    """Return the camera section of pictures as large as a robot's.

    Args:
      image: the entry `image` of a policy spec.
    """
    camera = image["camera"]
    return CameraConfig(
        width=SIDE,
        height=SIDE,
        position=tuple(camera["position"]),
        pitch=camera["pitch_down_degrees"],
        lens=camera["lens"],
        matrix=tuple(camera["matrix"][name] for name in ("fx", "fy", "cx", "cy")),
        calibration_size=(image["width"], image["height"]),
        distortion=tuple(camera["distortion"]),
    )


class SimulatedCamera:
    """A simulated camera on a simulated robot; it takes pictures while the robot's clock runs."""

    def __init__(
        self,
        robot: SimulatedJetBot,
        config: CameraConfig,
        model: CameraModel | None = None,
        *,
        appearance: SceneryKind = "plain",
    ) -> None:
        """Build the scene.

        Args:
          robot: the robot that carries the camera.
          config: the camera section of the pictures.
          model: delays and losses; None: the defaults of `CameraModel`.
          appearance: `plain` or `varied`.

        Raises:
          UserError: this machine has no OpenGL.
        """
        self.model = CameraModel() if model is None else model
        scene = make_mj_model(RobotConfig(preset="real"), PhysicsConfig())
        self._camera = MujocoCamera(config, scene, appearance=appearance)
        self._robot, self._rng = robot, np.random.default_rng(0)
        robot.watchers.append(self._look)
        self.begin(None)

    def begin(self, goal: tuple[float, float] | None, scenery: int = 0) -> None:
        """Forget all pictures, and begin with a new goal.

        Args:
          goal: position (x, y) of the cube [m]; None: there is none.
          scenery: number of the scenery, with varied appearance.
        """
        self.goal = goal
        """Position (x, y) of the cube [m]; it may be moved."""
        self.fault: Fault | None = None
        """The fault that the camera has now; None: it works."""
        self._scenery = scenery
        self._next = self._robot.now()
        self._last: _Picture | None = None
        self._value: _Picture | None = None
        self._pending: collections.deque[tuple[float, _Picture]] = collections.deque()

    @property
    def value(self) -> _Picture | None:
        """Return the newest picture that has arrived; None: there was none."""
        while self._pending and self._pending[0][0] <= self._robot.now() + 1e-9:
            self._value = self._pending.popleft()[1]
        return self._value

    def _look(self) -> None:
        """Take a picture if it is time."""
        now = self._robot.now()
        if now < self._next - 1e-9:
            return
        self._next += 1.0 / self.model.rate
        if self.fault == "missing" or self._rng.random() < self.model.dropped:
            return
        self._pending.append((now + self.model.latency, self._picture()))

    def _picture(self) -> _Picture:
        if self.fault == "frozen" and self._last is not None:
            return self._last
        goal = _HIDDEN if self.goal is None else (*self.goal, GOAL_HEIGHT)
        places = {"goal": np.array(goal)}
        if self.fault == "black":
            picture = np.zeros((SIDE, SIDE, 3), np.uint8)
        else:
            picture = self._camera.picture(*self._robot.attitude(), places, self._scenery)
        most = self.model.noise
        noise = self._rng.integers(-most, most, picture.shape, np.int16, endpoint=True)
        self._last = np.clip(picture[:, :, ::-1] + noise, 0, 255).astype(np.uint8)
        return self._last
