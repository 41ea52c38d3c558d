"""Move the cameras of a player's page, each so that it suits the size of its own window."""

import dataclasses
import itertools
from typing import Literal, get_args

import numpy as np
import viser
from jaxtyping import Float

from jetbot_mjx.viewers.camera import camera_axes, eye_that_sees

Camera = Literal["robot and goal", "behind the robot", "overview", "free"]
CAMERAS: tuple[Camera, ...] = get_args(Camera)

_AHEAD: dict[Camera, tuple[float, float, float]] = {
    "robot and goal": (0.55, 0.8, -1.0),
    "overview": (0.0, 0.75, -1.0),
}  # initial direction of view of a page that begins so
_FOV = 55.0  # [degrees] in height
_PANEL = 340  # [pixels] width of the panel, which hides the right side of the page
_SMALLEST_OPEN = 0.4  # fraction of a narrow page that is used beside the panel nevertheless
_FILLED = 0.88  # fraction of the view that may be filled, from its middle to each border
_NEAREST = 0.8  # [m] smallest distance from the camera to what it shows
_TOLERANCE = 0.02  # [m] change of the shown box from which the camera moves
_GLIDE = 0.15  # share of the remaining way per frame
_REPORTED_FRAMES = 30  # frames after a move until the page has reported where its camera is
_ARRIVED = 0.003  # [m] remaining way that ends a move

_BEHIND_B = (-0.65, 0.45)  # [m] position of the chasing camera behind and above the robot
_AHEAD_B = 0.3  # [m] its target in front of the robot
_LAG = 0.095  # share of the robot's turn that it makes up for per frame


@dataclasses.dataclass
class _Move:
    """A `_Move` holds where the camera of a client and its target are, and where they go [m]."""

    shown: Float[np.ndarray, "2 4"]
    at_w: Float[np.ndarray, "2 3"]
    to_w: Float[np.ndarray, "2 3"]
    frames_since_arrival: int = -1


class Cameras:
    """A `Cameras` object aims the cameras of all clients at the same things.

    A camera that has arrived is not touched until something else is to be seen, so that the user
    can turn and zoom it. A user's direction of view is kept.
    """

    def __init__(
        self, server: viser.ViserServer, mode: Literal["robot and goal", "overview"]
    ) -> None:
        """Set where a page begins to look from.

        Args:
          server: the viser server.
          mode: the behaviour of the cameras at first.
        """
        self._server = server
        self._mode: Camera = mode
        self._moves: dict[int, _Move] = {}
        self._yaw = 0.0
        self._ahead_w = np.array(_AHEAD[mode])
        server.initial_camera.position = -self._ahead_w
        server.initial_camera.look_at = np.zeros(3)
        server.initial_camera.fov = np.deg2rad(_FOV)

    @property
    def mode(self) -> Camera:
        """Behaviour of the cameras, one of `CAMERAS`."""
        return self._mode

    @mode.setter
    def mode(self, mode: Camera) -> None:
        self._mode = mode
        for move in self._moves.values():
            move.shown = np.full((2, 4), np.inf)

    def show(self, low_w: Float[np.ndarray, "3"], high_w: Float[np.ndarray, "3"]) -> None:
        """Move each camera towards the nearest place from which it sees a box beside the panel.

        Args:
          low_w: the lower corner of the box [m].
          high_w: the upper corner of the box [m].
        """
        clients = self._server.get_clients()
        self._moves = {key: move for key, move in self._moves.items() if key in clients}
        for key, client in clients.items():
            size = client.camera.image_width, client.camera.image_height
            shown = np.column_stack([[low_w, high_w], size])
            move = self._moves.get(key)
            if move is None or not np.abs(shown - move.shown).max() < _TOLERANCE:
                move = self._moves[key] = _plan(client.camera, shown, move, self._ahead_w)
            if move.frames_since_arrival < 0:
                _advance(client.camera, move)
            else:
                move.frames_since_arrival += 1

    def chase(self, robot_w: Float[np.ndarray, "3"], yaw: float) -> None:
        """Place the cameras behind the robot.

        Args:
          robot_w: the position of the robot [m].
          yaw: its heading [rad].
        """
        turn = (yaw - self._yaw + np.pi) % (2 * np.pi) - np.pi
        self._yaw += _LAG * turn
        ahead = np.array([np.cos(self._yaw), np.sin(self._yaw), 0.0])
        for client in self._server.get_clients().values():
            client.camera.position = robot_w + _BEHIND_B[0] * ahead + [0.0, 0.0, _BEHIND_B[1]]
            client.camera.look_at = robot_w + _AHEAD_B * ahead


def _advance(camera: viser.CameraHandle, move: _Move) -> None:
    """Go a share of the remaining way."""
    way_w = move.to_w - move.at_w
    arrives = np.abs(way_w).max() < _ARRIVED
    move.frames_since_arrival = 0 if arrives else -1
    move.at_w = move.at_w + (1.0 if arrives else _GLIDE) * way_w
    # Setting the position shifts the target too, so it comes first.
    camera.position, camera.look_at = move.at_w


def _plan(
    camera: viser.CameraHandle,
    shown: Float[np.ndarray, "2 4"],
    before: _Move | None,
    ahead_w: Float[np.ndarray, "3"],
) -> _Move:
    """Plan a move from where the camera is; a new page's camera looks along `ahead_w` at once."""
    # The page reports its camera with a delay, and meanwhile in parts.
    if before is None:
        at_w = np.stack([-ahead_w, np.zeros(3)])
    elif before.frames_since_arrival > _REPORTED_FRAMES:
        at_w = np.array([camera.position, camera.look_at])
    else:
        at_w = before.at_w
    axes_w = camera_axes(at_w[1] - at_w[0])
    corners_w = np.array(list(itertools.product(*shown[:, :3].T)))
    width, height = shown[0, 3], shown[1, 3]
    eye_w = eye_that_sees(corners_w, axes_w, _slopes(camera.fov, width, height), _NEAREST)
    # The user turns the camera around the middle of the box, as deep as it lies in the view.
    depth = axes_w[2] @ (corners_w.mean(axis=0) - eye_w)
    to_w = np.stack([eye_w, eye_w + depth * axes_w[2]])
    return _Move(shown, to_w if before is None else at_w, to_w)


def _slopes(fov: float, width: float, height: float) -> Float[np.ndarray, "4"]:
    """Return the borders of the page beside the panel, less a margin, for `eye_that_sees`.

    Args:
      fov: the field of view in height [rad].
      width: the width of the page [pixels].
      height: the height of the page [pixels].
    """
    open_width = max(width - _PANEL, _SMALLEST_OPEN * width)
    middle = open_width / 2
    left, right = width / 2 - (1 - _FILLED) * middle, open_width - width / 2
    per_pixel = 2 * np.tan(fov / 2) / height
    filled = _FILLED * height / 2
    return per_pixel * np.array([left, right - (1 - _FILLED) * middle, filled, filled])
