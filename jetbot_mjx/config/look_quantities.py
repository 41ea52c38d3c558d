"""Declare every quantity by which what the camera sees may differ from the plain scene.

A further quantity is declared here, and applied where its like are: colours and lights in
`envs.camera.looks`, the mount in `envs.camera.render`, delays and lost images in
`envs.camera.timing`.
"""

from typing import Annotated, NamedTuple

from jetbot_mjx.config.quantities import ANGLE, Evaluated, Range, Value, differs


class LookParams(NamedTuple):
    """A `LookParams` holds how the world looks to one robot's camera in one episode.

    Each field is a number or a traced scalar: one compiled program serves all values, and each
    episode may have its own. The defaults are the plain scene. A parameter at its default costs
    nothing: the program of an image omits its code.
    """

    differs = differs

    cube_brightness: Annotated[
        Value,
        Range(0, 4, "EST paints from dark to bright"),
        Evaluated("brightness of the cube", "× scene", (0.4, 0.6, 0.8, 1.0, 1.2, 1.5)),
    ] = 1.0
    """Factor on the colour of the goal's cube."""
    cube_red: Annotated[
        Value,
        Range(0, 8, "EST reds of another maker"),
        Evaluated("red of the cube", "× scene", (0.7, 0.85, 1.0, 1.15)),
    ] = 1.0
    """Further factor on the cube's red."""
    cube_blue: Annotated[
        Value,
        Range(0, 8, "EST from orange to pink"),
        Evaluated("blue of the cube", "× scene", (0.5, 1.0, 2.0, 4.0)),
    ] = 1.0
    """Further factor on the cube's blue."""
    cube_yaw: Annotated[
        Value,
        Range(-ANGLE, ANGLE, "EST any; a cube looks alike after a quarter turn"),
        Evaluated("turn of the cube", "rad", (-0.785, -0.4, 0.0, 0.4, 0.785)),
    ] = 0.0
    """[rad] turn of the cube about the vertical, counter-clockwise."""
    floor_brightness: Annotated[
        Value,
        Range(0, 4, "EST from a dark carpet to white tiles"),
        Evaluated("brightness of the floor", "× scene", (0.15, 0.3, 0.6, 1.0, 1.2)),
    ] = 1.0
    """Factor on the colours of the floor."""
    floor_red: Annotated[
        Value,
        Range(0, 8, "EST wood has 1.1 to 1.4 times as much red as green"),
        Evaluated("red of the floor", "× scene", (0.8, 1.0, 1.2, 1.5)),
    ] = 1.0
    """Further factor on the floor's red."""
    floor_blue: Annotated[
        Value,
        Range(0, 8, "EST wood has 0.5 to 0.8 times as much blue as green"),
        Evaluated("blue of the floor", "× scene", (0.5, 0.75, 1.0, 1.2)),
    ] = 1.0
    """Further factor on the floor's blue."""
    floor_contrast: Annotated[
        Value,
        Range(0, 8, "EST from plain to black and white tiles"),
        Evaluated("contrast of the floor", "× scene", (0.0, 0.5, 1.0, 2.0, 4.0)),
    ] = 1.0
    """Factor on the difference between the two colours of the floor and their mean."""
    floor_texture: Annotated[
        Value,
        Range(0, 3, "EST tiles, boards, tiles with joints, carpets", whole=True),
        Evaluated("pattern of the floor", "kind", (0.0, 1.0, 2.0, 3.0)),
    ] = 0.0
    """Pattern of the floor: 0 checker, 1 stripes, 2 tiles with joints, 3 soft spots."""
    floor_scale: Annotated[
        Value,
        Range(0.05, 20, "EST from mosaic to large tiles"),
        Evaluated("size of the pattern", "× 0.5 m", (0.1, 0.3, 1.0, 2.0)),
    ] = 1.0
    """Factor on the size of the pattern; the checker's squares have half a metre."""
    floor_yaw: Annotated[
        Value,
        Range(-ANGLE, ANGLE, "EST any"),
        Evaluated("turn of the pattern", "rad", (-0.785, -0.4, 0.0, 0.4, 0.785)),
    ] = 0.0
    """[rad] turn of the pattern, counter-clockwise."""
    sky_brightness: Annotated[
        Value,
        Range(0, 4, "EST a room by night or day"),
        Evaluated("brightness of the sky", "× scene", (0.2, 0.5, 0.8, 1.0, 1.2)),
    ] = 1.0
    """Factor on the colours of the sky."""
    sky_red: Annotated[
        Value,
        Range(0, 8, "EST lamps from 2,700 to 6,500 K"),
        Evaluated("red of the sky", "× scene", (0.7, 0.85, 1.0, 1.2)),
    ] = 1.0
    """Further factor on the sky's red."""
    sky_blue: Annotated[
        Value,
        Range(0, 8, "EST lamps from 2,700 to 6,500 K"),
        Evaluated("blue of the sky", "× scene", (0.6, 0.8, 1.0, 1.2)),
    ] = 1.0
    """Further factor on the sky's blue."""
    walls: Annotated[
        Value,
        Range(0, 0.8, "EST rooms of 2.7 m and more"),
        Evaluated("nearness of walls", "1/m", (0.0, 0.2, 0.4, 0.6, 0.75)),
    ] = 0.0
    """[1/m] nearness of four walls around the origin, 1/distance; 0: none. Their turn, height and
    colours are drawn too."""
    clutter: Annotated[
        Value,
        Range(0, 8, "EST a room that is not tidy", whole=True),
        Evaluated("objects around", "objects", (0.0, 1.0, 2.0, 4.0)),
    ] = 0.0
    """Number of objects around, in drawn places and in colours unlike the cube's; only to see."""
    ambient: Annotated[
        Value,
        Range(0, 4, "EST window or lamp"),
        Evaluated("light from all sides", "× scene", (0.3, 0.6, 1.0, 1.5, 2.0)),
    ] = 1.0
    """Factor on the light from all sides."""
    light: Annotated[
        Value,
        Range(0, 4, "EST from an overcast day to a spot"),
        Evaluated("light with a direction", "× scene", (0.0, 0.3, 0.6, 1.0, 1.5)),
    ] = 1.0
    """Factor on the strength of the lights with a direction."""
    light_x: Annotated[
        Value,
        Range(-5, 5, "EST windows to 30 degrees above the horizon"),
        Evaluated("tilt of the light, forward", "m/m", (-2.0, -1.0, 0.0, 1.0, 2.0)),
    ] = 0.0
    """[m/m] slope by which these lights are tilted, forwards as seen from the start."""
    light_y: Annotated[
        Value,
        Range(-5, 5, "EST windows to 30 degrees above the horizon"),
        Evaluated("tilt of the light, left", "m/m", (-2.0, -1.0, 0.0, 1.0, 2.0)),
    ] = 0.0
    """[m/m] slope by which these lights are tilted to the left."""
    exposure: Annotated[
        Value,
        Range(0, 8, "EST one stop either way"),
        Evaluated("exposure", "× scene", (0.3, 0.5, 0.75, 1.0, 1.5, 2.0)),
    ] = 1.0
    """Factor on all channels, before they are clipped at white."""
    red_gain: Annotated[
        Value,
        Range(0, 4, "IMX219; EST ±20 %"),
        Evaluated("white balance, red", "× scene", (0.7, 0.85, 1.0, 1.2, 1.4)),
    ] = 1.0
    """Factor on the red channel: white balance."""
    blue_gain: Annotated[
        Value,
        Range(0, 4, "IMX219; EST ±20 %"),
        Evaluated("white balance, blue", "× scene", (0.7, 0.85, 1.0, 1.2, 1.4)),
    ] = 1.0
    """Factor on the blue channel: white balance."""
    pixel_noise: Annotated[
        Value,
        Range(0, 1, "EST 2 to 5 % by lamp light"),
        Evaluated("noise of the pixels", "of white", (0.0, 0.02, 0.05, 0.1, 0.2)),
    ] = 0.0
    """Standard deviation of the noise of every pixel and channel; white is 1."""
    blur: Annotated[
        Value,
        Range(0, 8, "EST a lens out of focus"),
        Evaluated("blur", "pixels", (0.0, 0.5, 1.0, 2.0, 4.0)),
    ] = 0.0
    """[pixels] how much wider than one pixel the area is that a pixel averages."""
    camera_x: Annotated[
        Value,
        Range(-0.05, 0.05, "DUCKIETOWN ±5 mm"),
        Evaluated("camera, forward", "m", (-0.01, -0.005, 0.0, 0.005, 0.01)),
    ] = 0.0
    """[m] shift of the camera forwards."""
    camera_y: Annotated[
        Value,
        Range(-0.05, 0.05, "DUCKIETOWN ±5 mm"),
        Evaluated("camera, left", "m", (-0.01, -0.005, 0.0, 0.005, 0.01)),
    ] = 0.0
    """[m] shift of the camera to the left."""
    camera_z: Annotated[
        Value,
        Range(-0.05, 0.05, "DUCKIETOWN height ±8 %"),
        Evaluated("camera, up", "m", (-0.014, -0.007, 0.0, 0.007, 0.014)),
    ] = 0.0
    """[m] shift of the camera upwards."""
    camera_pitch: Annotated[
        Value,
        Range(-1, 1, "DUCKIETOWN ±20 % of its tilt, 4 degrees"),
        Evaluated("camera, pitch", "rad", (-0.14, -0.07, 0.0, 0.07, 0.14)),
    ] = 0.0
    """[rad] angle by which the camera looks further down."""
    camera_roll: Annotated[
        Value,
        Range(-1, 1, "EST how straight a sensor is mounted, 3 degrees"),
        Evaluated("camera, roll", "rad", (-0.1, -0.05, 0.0, 0.05, 0.1)),
    ] = 0.0
    """[rad] turn of the camera about its axis, clockwise as seen from behind."""
    camera_yaw: Annotated[
        Value,
        Range(-1, 1, "EST how straight a sensor is mounted, 3 degrees"),
        Evaluated("camera, yaw", "rad", (-0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2)),
    ] = 0.0
    """[rad] turn of the camera to the left."""
    focal_length: Annotated[
        Value,
        Range(0.5, 2, "DUCKIETOWN field of view ±20 %"),
        Evaluated("focal length", "× camera", (0.8, 0.9, 1.0, 1.15, 1.3)),
    ] = 1.0
    """Factor on the focal length; above 1 the field of view is narrower."""
    distortion: Annotated[
        Value,
        Range(-0.3, 0.3, "EST what is left of a wide lens after undistortion"),
        Evaluated("distortion of the lens", "share in the corner", (-0.3, -0.15, 0.0, 0.15, 0.3)),
    ] = 0.0
    """Share by which the ray of the farthest pixel is bent outwards."""
    camera_delay: Annotated[
        Value,
        Range(0, 60, "EST 30 to 100 ms from light to policy", whole=True),
        Evaluated("delay of images", "control steps", (0.0, 1.0, 2.0, 3.0, 6.0, 9.0)),
    ] = 0.0
    """[control steps] delay of the images."""
    camera_interval: Annotated[
        Value,
        Range(1, 60, "BOM cameras of 10 to 60 images a second", whole=True),
        Evaluated("steps between images", "control steps", (1.0, 2.0, 3.0, 6.0)),
    ] = 1.0
    """[control steps] from one image to the next; in between the last one stays."""
    frame_drop: Annotated[
        Value,
        Range(0, 1, "EST 5 % on a busy computer"),
        Evaluated("lost images", "probability", (0.0, 0.05, 0.1, 0.3, 0.5)),
    ] = 0.0
    """Probability that an image is lost, and the one before it stays."""
