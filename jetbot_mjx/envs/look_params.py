"""Define look parameters: how what the camera sees differs from the plain scene.

Like robot parameters they are data: one compiled program serves all values, and each episode may
have its own. Colours and lights enter the image in `camera.looks`, the mount in `camera.render`,
delays and lost images in `camera.timing`.
"""

from typing import NamedTuple

from jetbot_mjx.envs.robot_params import Quantity, differs

MAX_CAMERA_DELAY = 9
"""Longest `camera_delay` [control steps] of a traced delay: 150 ms at the default `ctrl_dt`."""

MAX_CLUTTER = 4
"""Largest `clutter` if it is traced."""


class LookParams(NamedTuple):
    """A `LookParams` holds how the world looks to one robot's camera in one episode.

    The defaults are the plain scene. A parameter at its default costs nothing: the program of an
    image omits its code.
    """

    cube_brightness: Quantity = 1.0
    """Factor on the colour of the goal's geoms."""
    cube_red: Quantity = 1.0
    """Further factor on the red of the goal's geoms."""
    cube_blue: Quantity = 1.0
    """Further factor on the blue of the goal's geoms."""
    cube_yaw: Quantity = 0.0
    """Turn of the goal's geoms about the vertical [rad], counter-clockwise; only as they look."""
    floor_brightness: Quantity = 1.0
    """Factor on the colours of the ground."""
    floor_red: Quantity = 1.0
    """Further factor on the red of the ground."""
    floor_blue: Quantity = 1.0
    """Further factor on the blue of the ground."""
    floor_contrast: Quantity = 1.0
    """Factor on the difference between the two colours of the ground and their mean."""
    floor_texture: Quantity = 0.0
    """Pattern of a checkered ground: 0 checker, 1 stripes, 2 tiles with joints, 3 soft spots."""
    floor_scale: Quantity = 1.0
    """Factor on the size of the pattern."""
    floor_yaw: Quantity = 0.0
    """Turn of the pattern [rad], counter-clockwise about the world's origin."""
    sky_brightness: Quantity = 1.0
    """Factor on the colours of the sky."""
    sky_red: Quantity = 1.0
    """Further factor on the red of the sky."""
    sky_blue: Quantity = 1.0
    """Further factor on the blue of the sky."""
    walls: Quantity = 0.0
    """Nearness of four walls around the origin [1/m]: 1 / distance; 0: there are none. Their turn,
    height and colours are drawn with the episode."""
    clutter: Quantity = 0.0
    """Number of objects around, rounded; places and colours are drawn with the episode."""
    ambient: Quantity = 1.0
    """Factor on the light from all sides."""
    light: Quantity = 1.0
    """Factor on the strength of the directional lights."""
    light_x: Quantity = 0.0
    """Slope by which directional lights are tilted along the world's x axis: metres for each metre
    down."""
    light_y: Quantity = 0.0
    """Slope by which directional lights are tilted along the world's y axis."""
    exposure: Quantity = 1.0
    """Factor on all channels, before they are clipped at white."""
    red_gain: Quantity = 1.0
    """Factor on the red channel: white balance."""
    blue_gain: Quantity = 1.0
    """Factor on the blue channel: white balance."""
    pixel_noise: Quantity = 0.0
    """Standard deviation of the noise of every pixel and channel; white is 1."""
    blur: Quantity = 0.0
    """How much wider than one pixel the area is that a pixel averages [pixels]."""
    camera_x: Quantity = 0.0
    """Shift of the camera forward [m], body frame."""
    camera_y: Quantity = 0.0
    """Shift of the camera to the left [m], body frame."""
    camera_z: Quantity = 0.0
    """Shift of the camera up [m], body frame."""
    camera_pitch: Quantity = 0.0
    """Angle by which the camera looks further down [rad]."""
    camera_roll: Quantity = 0.0
    """Turn of the camera about its axis [rad], clockwise as seen from behind."""
    camera_yaw: Quantity = 0.0
    """Turn of the camera to the left [rad]."""
    focal_length: Quantity = 1.0
    """Factor on the focal length; above 1 the field of view is narrower."""
    distortion: Quantity = 0.0
    """Share by which the ray of the farthest pixel is bent outwards; the share of the others falls
    with the square of the distance from the optical axis."""
    camera_delay: Quantity = 0.0
    """Delay of the images [control steps], rounded."""
    camera_interval: Quantity = 1.0
    """Control steps from one image to the next, rounded; in between the last one stays."""
    frame_drop: Quantity = 0.0
    """Probability that an image is lost, and the one before it stays."""

    def differs(self, *names: str) -> bool:
        """Return whether any of some parameters may differ from the plain scene.

        Args:
          *names: the parameters; a traced one may always differ.
        """
        return differs(self, names)
