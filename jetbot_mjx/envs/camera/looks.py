"""Apply look parameters to the scene, the rays and the pixels of one image.

Whatever differs becomes data that the pixels of an image share, so that one kernel serves all
episodes. Whatever does not differ stays a constant of the kernel, which is therefore the kernel of
the plain scene as long as nothing differs.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8, UInt32

from jetbot_mjx.config import LookParams
from jetbot_mjx.envs.camera.geometry import Scalar, triple
from jetbot_mjx.envs.camera.lens import Footprint, Rays
from jetbot_mjx.envs.camera.scene import GOAL, Checker, Rgb, Scene, SceneGeom, ground_of
from jetbot_mjx.envs.camera.surroundings import Surroundings

IN_PIXELS = (
    *("cube_brightness", "cube_red", "cube_blue", "cube_yaw"),
    *("floor_brightness", "floor_red", "floor_blue", "floor_contrast"),
    *("floor_texture", "floor_scale"),
    *("sky_brightness", "sky_red", "sky_blue", "ambient", "light"),
    *("exposure", "red_gain", "blue_gain", "focal_length", "distortion", "blur"),
)
"""Parameters that enter the function of one pixel."""


class Appearance(NamedTuple):
    """An `Appearance` holds how the world looks to one camera."""

    params: LookParams = LookParams()
    surroundings: Surroundings = Surroundings()


PLAIN = Appearance()
"""The plain scene."""


def styled(scene: Scene, params: LookParams) -> Scene:
    """Return a scene with other colours and lights, which may be traced; itself if none differs.

    Args:
      scene: the scene.
      params: the look parameters.
    """
    tints = {
        place: tuple(getattr(params, f"{place}_{part}") for part in ("red", "brightness", "blue"))
        for place in ("cube", "floor", "sky")
        if params.differs(*(f"{place}_{part}" for part in ("red", "brightness", "blue")))
    }
    ground = ground_of(scene)
    geoms = []
    for index, geom in enumerate(scene.geoms):
        place = "floor" if index == ground else "cube" if geom.mocap == GOAL else None
        if place in tints:
            geom = geom._replace(rgb=_tinted(geom.rgb, tints[place]))
        if place == "cube" and params.differs("cube_yaw"):
            geom = geom._replace(yaw=params.cube_yaw)
        if place == "floor" and geom.checker is not None:
            geom = geom._replace(checker=_styled_checker(geom, tints.get("floor"), params))
        geoms.append(geom)
    scene = scene._replace(geoms=tuple(geoms))
    if tint := tints.get("sky"):
        zenith = None if scene.zenith is None else _tinted(scene.zenith, tint)
        scene = scene._replace(horizon=_tinted(scene.horizon, tint), zenith=zenith)
    return _lit(scene, params)


def _tinted(rgb: Rgb, tint: Sequence[Scalar]) -> Rgb:
    red, brightness, blue = tint
    return rgb[0] * brightness * red, rgb[1] * brightness, rgb[2] * brightness * blue


def _styled_checker(geom: SceneGeom, tint: Sequence[Scalar] | None, params: LookParams) -> Checker:
    checker = geom.checker
    assert checker is not None
    even, odd = checker.even, checker.odd
    if params.differs("floor_contrast"):
        means = [0.5 * (a + b) for a, b in zip(even, odd, strict=True)]

        def spread(rgb: Rgb) -> Rgb:
            pairs = zip(rgb, means, strict=True)
            return triple(m + params.floor_contrast * (x - m) for x, m in pairs)

        even, odd = spread(even), spread(odd)
    if tint is not None:
        even, odd = _tinted(even, tint), _tinted(odd, tint)
    checker = checker._replace(even=even, odd=odd)
    if params.differs("floor_scale"):
        width, length = checker.size
        checker = checker._replace(size=(width * params.floor_scale, length * params.floor_scale))
    if params.differs("floor_texture"):
        checker = checker._replace(texture=params.floor_texture)
    return checker


def _lit(scene: Scene, params: LookParams) -> Scene:
    """Return a scene with other lights."""
    if params.differs("ambient"):
        scene = scene._replace(ambient=triple(params.ambient * x for x in scene.ambient))
    if params.differs("light", "light_x", "light_y"):
        lights = []
        for light in scene.lights:
            diffuse, direction = triple(params.light * x for x in light.diffuse), light.direction
            if params.differs("light_x", "light_y"):
                slope = jnp.stack([jnp.asarray(params.light_x), jnp.asarray(params.light_y)])
                tilt = jnp.append(slope, 0.0) * abs(light.direction[2])
                direction = light.direction + tilt
                direction = direction / jnp.linalg.norm(direction)
            lights.append(light._replace(direction=direction, diffuse=diffuse))
        scene = scene._replace(lights=tuple(lights))
    return scene


def pixel_values(params: LookParams) -> dict[str, Scalar]:
    """Return the parameters that differ and enter the pixels, by name."""
    return {name: getattr(params, name) for name in IN_PIXELS if params.differs(name)}


def bend_rays(
    params: Mapping[str, Scalar], samples: Sequence[Rays], footprint: Footprint, farthest: float
) -> tuple[Sequence[Rays], Footprint]:
    """Return the directions of a pixel's rays for another lens.

    A ray (x, y) of the plain lens becomes (x, y) (1 + k r²/R²) / f, where f is `focal_length`, k is
    `distortion` and R the r of the farthest pixel. `blur` moves the rays away from the pixel's
    centre first.

    Args:
      params: the look parameters that differ.
      samples: the directions of the pixel's rays.
      footprint: the extent of the pixel.
      farthest: R² above.
    """
    if not {"focal_length", "distortion", "blur"} & params.keys():
        return samples, footprint
    zoom = 1.0 / jnp.asarray(params.get("focal_length", 1.0))
    bend = jnp.asarray(params.get("distortion", 0.0)) / farthest
    wide = 1.0 + jnp.asarray(params.get("blur", 0.0))
    centre = footprint.centre
    around = bend * (centre.x * centre.x + centre.y * centre.y)

    def bent(rays: Rays) -> Rays:
        x = centre.x + wide * (rays.x - centre.x)
        y = centre.y + wide * (rays.y - centre.y)
        scale = zoom * (1.0 + bend * (x * x + y * y))
        return Rays(scale * x, scale * y)

    def changed(rays: Rays) -> Rays:
        """Return the change of a bent ray where the plain one changes by `rays`."""
        outwards = 2.0 * bend * (centre.x * rays.x + centre.y * rays.y)
        x = rays.x * (1.0 + around) + centre.x * outwards
        y = rays.y * (1.0 + around) + centre.y * outwards
        return Rays(wide * zoom * x, wide * zoom * y)

    scale = zoom * (1.0 + around)
    middle = Rays(scale * centre.x, scale * centre.y)
    extent = Footprint(middle, changed(footprint.right), changed(footprint.down))
    return [bent(rays) for rays in samples], extent


def developed(params: Mapping[str, Scalar], channels: Sequence[Scalar]) -> list[Scalar]:
    """Return red, green and blue after exposure and white balance.

    Args:
      params: the look parameters that differ.
      channels: red, green and blue, 1 is white.
    """
    gains = [params.get("red_gain"), None, params.get("blue_gain")]
    exposed = [x if "exposure" not in params else x * params["exposure"] for x in channels]
    return [x if gain is None else x * gain for x, gain in zip(exposed, gains, strict=True)]


def add_noise(
    image: UInt8[Array, "h w c"], deviation: Scalar, seed: UInt32[Array, ""]
) -> UInt8[Array, "h w c"]:
    """Add noise to every pixel and channel by itself, and clip.

    The noise is the sum of the four bytes of a hash of seed and place, which is nearly normal: its
    kurtosis is 2.7 and it ends at 3.5 deviations. A hash of two multiplications costs a fraction of
    JAX's own random numbers. Source of its constants: Chris Wellons, hash-prospector, lowbias32.

    Args:
      image: the image.
      deviation: standard deviation; white is 1.
      seed: another number for every image.
    """
    place = jnp.arange(image.size, dtype=jnp.uint32).reshape(image.shape)
    x = place * jnp.uint32(0x9E3779B9) + seed
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    x = x ^ (x >> 16)
    # Add pairs of bytes first: both sums stay below 2^16.
    pairs = (x & 0x00FF00FF) + ((x >> 8) & 0x00FF00FF)
    total = (pairs & 0xFFFF) + (pairs >> 16)
    normal = (total.astype(jnp.float32) - 510.0) / math.sqrt(4 * (256**2 - 1) / 12)
    noisy = image.astype(jnp.float32) + (255.0 * jnp.asarray(deviation)) * normal
    return jnp.clip(jnp.floor(noisy + 0.5), 0.0, 255.0).astype(jnp.uint8)


def turned(rotation: np.ndarray | Array, yaw: Scalar) -> Float[Array, "3 3"]:
    """Return axes turned about the vertical, counter-clockwise [rad]."""
    x, y, z = jnp.asarray(rotation)
    cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y, z])
