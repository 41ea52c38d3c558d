"""Draw scenery for MuJoCo's renderer: lights, floor and sky that no training has rendered."""

from typing import Literal, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from jetbot_mjx.envs.camera.scene import skyboxes, texture_bytes

SceneryKind = Literal["plain", "varied"]
"""`plain`: lights, floor and sky of the scene; `varied`: drawn ones."""

SCENERIES = 16
"""Number of drawn sceneries: robot i of a batch sees number i modulo this."""

RANGES = {
    "light": (0.35, 0.75),  # strength of the sun
    "tilt": (0.0, 45.0),  # [deg] of the sun from the vertical
    "tint": (0.88, 1.0),  # of the sun, each channel
    "ambient": (0.20, 0.40),
    "headlight": (0.05, 0.30),
    "floor": (0.35, 0.95),  # brightness of each of its two colours
    "floor_tint": (0.85, 1.0),  # of the floor, each channel
    "repeat": (0.7, 3.0),  # [1/m] of the floor's texture
    "reflectance": (0.0, 0.15),
    "sky": (0.35, 1.0),  # brightness at the horizon and at the zenith
}
"""Ranges from which a scenery is drawn, uniformly."""

_FLOORS = ("checker", "solid", "noise")
_SKIES = ("gradient", "noise", "blocks")
_FLOOR_SIDE = 256  # [pixels]


class Scenery(NamedTuple):
    """A `Scenery` holds what MuJoCo's renderer shows besides the shapes."""

    direction: Float[np.ndarray, "3"]
    """Direction of the sun's rays, a unit vector in the world frame."""
    light: Float[np.ndarray, "3"]
    """Diffuse light of the sun."""
    ambient: float
    headlight: float
    floor: UInt8[np.ndarray, "side side 3"]
    """Texture of the floor."""
    repeat: float
    """Repetitions of the texture per metre."""
    reflectance: float
    """Share of light that the floor reflects like a mirror."""
    sky: UInt8[np.ndarray, "sides side side 3"]
    """The six sides of the sky box: right, left, up, down, front, back."""


def draw_scenery(number: int, side: int) -> Scenery:
    """Draw a scenery; the same number gives the same one.

    Args:
      number: the seed.
      side: the side length of the sky box [pixels].
    """
    rng = np.random.default_rng((0x736B79, number))

    def draw(name: str, size: int | None = None) -> float | np.ndarray:
        return rng.uniform(*RANGES[name], size)

    tilt, turn = np.radians(draw("tilt")), rng.uniform(0.0, 2.0 * np.pi)
    down = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    colours = np.stack([draw("floor") * draw("floor_tint", 3) for _ in range(2)])
    # Take every kind of floor and sky in turn, so that few sceneries show all of them.
    floor = _FLOORS[number % len(_FLOORS)]
    sky = _SKIES[number // len(_FLOORS) % len(_SKIES)]
    return Scenery(
        direction=down,
        light=np.asarray(draw("light") * draw("tint", 3)),
        ambient=float(draw("ambient")),
        headlight=float(draw("headlight")),
        floor=_floor(floor, colours, rng),
        repeat=float(draw("repeat")),
        reflectance=float(draw("reflectance")),
        sky=_sky(sky, side, rng),
    )


def paint(model: mujoco.MjModel, scenery: Scenery) -> list[int]:
    """Apply a scenery to a model.

    Args:
      model: the model, which is modified. What it has no light, texture or material for stays.
      scenery: the scenery.

    Returns:
      The indices of the textures that changed.
    """
    headlight = model.vis.headlight
    headlight.ambient[:], headlight.diffuse[:] = scenery.ambient, scenery.headlight
    if model.nlight:
        model.light_dir[0], model.light_diffuse[0] = scenery.direction, scenery.light
        model.light_castshadow[0] = True
    changed = []
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    for material in np.unique(model.geom_matid[planes & (model.geom_matid >= 0)]).tolist():
        model.mat_texrepeat[material] = scenery.repeat
        model.mat_reflectance[material] = scenery.reflectance
        texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
        if texture >= 0:
            height, width, _ = texture_bytes(model, texture).shape
            changed += _write(model, texture, _resized(scenery.floor, height, width))
    for texture in skyboxes(model):
        changed += _write(model, texture, scenery.sky.reshape(-1, *scenery.sky.shape[2:]))
    return changed


def sky_side(model: mujoco.MjModel) -> int:
    """Return the side length of a model's sky box [pixels]; a small one if it has none."""
    skies = skyboxes(model)
    return int(model.tex_width[skies[0]]) if skies else 8


def _resized(
    image: UInt8[np.ndarray, "side side 3"], height: int, width: int
) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image in another size, by the nearest pixels."""
    rows = np.arange(height) * len(image) // height
    return image[rows][:, np.arange(width) * len(image) // width]


def _write(model: mujoco.MjModel, texture: int, image: UInt8[np.ndarray, "h w 3"]) -> list[int]:
    """Write the pixels of a texture, if it has their size; return its index if it changed."""
    pixels = texture_bytes(model, texture)
    if image.shape != pixels.shape:
        return []
    pixels[:] = image
    return [texture]


def _floor(
    kind: str, colours: Float[np.ndarray, "2 3"], rng: np.random.Generator
) -> UInt8[np.ndarray, "side side 3"]:
    side = _FLOOR_SIDE
    if kind == "solid":
        share = np.zeros((side, side))
    elif kind == "checker":
        halves = np.arange(side) >= side // 2
        share = (halves[:, None] ^ halves[None, :]).astype(float)
    else:
        share = _noise(side, rng)
    return _bytes(colours[0] + share[..., None] * (colours[1] - colours[0]))


def _sky(kind: str, side: int, rng: np.random.Generator) -> UInt8[np.ndarray, "6 side side 3"]:
    """Return a sky box; `blocks` stand at the horizon like furniture, in no reddish colour."""
    horizon, zenith = (
        rng.uniform(*RANGES["sky"]) * rng.uniform(*RANGES["floor_tint"], 3) for _ in range(2)
    )
    up = np.clip(1.0 - 2.0 * (np.arange(side) + 0.5) / side, 0.0, 1.0)[None, :, None, None]
    sides = np.broadcast_to(horizon + up * (zenith - horizon), (6, side, side, 3)).copy()
    sides[2], sides[3] = zenith, horizon
    if kind == "noise":
        sides *= 1.0 - 0.35 * np.stack([_noise(side, rng) for _ in range(6)])[..., None]
    elif kind == "blocks":
        for wall in (0, 1, 4, 5):
            for _ in range(5):
                left, width, height = rng.uniform((0.0, 0.05, 0.03), (0.95, 0.25, 0.25))
                red, green, blue = rng.uniform(0.1, 0.9, 3)
                top = int((0.5 - height / 2) * side)
                columns = slice(int(left * side), int((left + width) * side))
                sides[wall, top:, columns] = min(red, green, blue), green, blue
    return _bytes(sides)


def _noise(side: int, rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    """Return periodic noise of several scales, from 0 to 1."""
    total = np.zeros((side, side))
    for cells in (4, 8, 16, 32):
        at = np.arange(side) * cells / side
        low = at.astype(int)
        share = at - low
        share = share * share * (3.0 - 2.0 * share)
        grid = rng.random((cells, cells))
        rows = grid[low] + share[:, None] * (grid[(low + 1) % cells] - grid[low])
        total += (
            (rows[:, low] + share * (rows[:, (low + 1) % cells] - rows[:, low])) * 2.0 / cells**0.5
        )
    return (total - total.min()) / (total.max() - total.min())


def _bytes(colours: Float[np.ndarray, "*shape 3"]) -> UInt8[np.ndarray, "*shape 3"]:
    return np.round(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)
