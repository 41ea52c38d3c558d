"""Read what a camera can see out of a MuJoCo model: geoms, colours, lights and the sky."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Array, Float, UInt8

from jetbot_mjx.envs.camera.geometry import Scalar, Size, Vector
from jetbot_mjx.errors import UserError

Rgb = Vector
"""Red, green and blue, 1 is white: numbers, or traced in the scene of one episode."""

GOAL = "goal"
"""Mocap body that marks the goal."""

_KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box")
"""MuJoCo's names of the geoms that can be drawn."""

_HIDDEN_GROUPS = 3
"""Geoms of this group and above are hidden, as in MuJoCo's viewers."""

_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_SKY = (0.0, 0.0, 0.0)


class Checker(NamedTuple):
    """A `Checker` holds a checker texture on a plane."""

    even: Rgb
    """Colour of the square whose least x and y are those of `start`."""
    odd: Rgb
    size: tuple[Scalar, Scalar]
    """Side lengths of a square [m]."""
    start: tuple[float, float]
    """Where the squares begin [m], in the plane's frame."""
    texture: Scalar | None = None
    """Pattern as of `LookParams.floor_texture`; None: a checker."""


class SceneGeom(NamedTuple):
    """A `SceneGeom` holds one geom, in the frame of the world or of a mocap body."""

    geom_id: int
    kind: str
    size: tuple[float, float, float]
    """Sizes [m] as in MuJoCo; a sphere has its radius three times."""
    rgb: Rgb
    mocap: str | None
    """The mocap body whose position is added to `position`; None: it stands still."""
    position: Float[np.ndarray, "3"]
    """Position [m] in the axes of the world."""
    rotation: Float[np.ndarray, "3 3"]
    """Axes of the geom, as columns, in the axes of the world."""
    emission: float = 0.0
    checker: Checker | None = None
    yaw: Scalar | None = None
    """Further turn about the vertical through the body [rad]; None: it is not turned."""

    @property
    def axes_key(self) -> bytes:
        """Return the same bytes for geoms that are turned alike."""
        return self.rotation.tobytes() + (b"" if self.yaw is None else b"yaw")


class Light(NamedTuple):
    """A `Light` holds a directional light."""

    direction: np.ndarray | Array
    """Direction of the light's rays, a unit vector in the world frame."""
    diffuse: Rgb


class Scene(NamedTuple):
    """A `Scene` holds what a camera can see."""

    geoms: tuple[SceneGeom, ...]
    ambient: Rgb
    headlight: Rgb
    """Diffuse light along the optical axis."""
    lights: tuple[Light, ...]
    horizon: Rgb
    """Colour of the sky at the horizon."""
    zenith: Rgb | None
    """Colour of the sky at the zenith; None: the sky has one colour."""


def ground_of(scene: Scene) -> int | None:
    """Return the index of the first plane that is infinite both ways; None: there is none."""
    infinite = (
        i
        for i, geom in enumerate(scene.geoms)
        if geom.kind == "plane" and geom.size[0] == geom.size[1] == 0
    )
    return next(infinite, None)


def read_scene(model: mujoco.MjModel, robot: str) -> Scene:
    """Return the visible geoms, lights and sky of a model.

    The robot itself is left out: its camera looks past it. Specular light, shadows, reflections,
    transparency and haze are not rendered. A plane may have MuJoCo's checker texture; any other
    texture is replaced by its mean colour.

    Args:
      model: the compiled model with its visual elements.
      robot: the name of the robot's body.

    Raises:
      UserError: a visible geom is a mesh, a height field or an SDF, moves by joints, or a light
        that is on has a position.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    robot_id = model.body(robot).id
    geoms = []
    for geom in range(model.ngeom):
        chain = _ancestors(model, int(model.geom_bodyid[geom]))
        hidden = model.geom_group[geom] >= _HIDDEN_GROUPS or geom_rgba(model, geom)[3] == 0
        if not hidden and robot_id not in chain:
            geoms.append(_read_geom(model, data, geom, chain))
    headlight = model.vis.headlight
    active = bool(headlight.active)
    horizon, zenith = _read_sky(model)
    return Scene(
        tuple(geoms),
        ambient=_rgb(headlight.ambient * active + model.light_active @ model.light_ambient),
        headlight=_rgb(headlight.diffuse * active),
        lights=tuple(
            _read_light(model, data, i) for i in np.flatnonzero(model.light_active).tolist()
        ),
        horizon=horizon,
        zenith=None if zenith == horizon else zenith,
    )


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and the bodies that carry it, without the world."""
    chain = []
    while body:
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain


def _rgb(values: Sequence[float] | np.ndarray) -> Size:
    red, green, blue = map(float, values)
    return red, green, blue


def geom_rgba(model: mujoco.MjModel, geom: int) -> tuple[float, float, float, float]:
    """Return the colour that MuJoCo draws: a geom's own if it is set, else its material's."""
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material >= 0 and np.allclose(own, _DEFAULT_RGBA):
        own = model.mat_rgba[material]
    red, green, blue, alpha = own.tolist()
    return red, green, blue, alpha


def _read_geom(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, chain: Sequence[int]
) -> SceneGeom:
    kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    name = model.geom(geom).name or f"geom {geom}"
    if kind not in _KINDS:
        raise UserError(
            f"task.observation: the camera cannot draw {name!r}, a {kind}: build it of"
            f" {', '.join(_KINDS)}, or hide it (group={_HIDDEN_GROUPS})"
        )
    if any(model.body_jntnum[body] for body in chain):
        raise UserError(
            f"task.observation: the camera cannot draw {name!r}, which moves by joints: only bodies"
            " that stand still and mocap bodies can be drawn"
        )
    mocap = next((body for body in chain if model.body_mocapid[body] >= 0), None)
    start = data.xpos[mocap] if mocap else np.zeros(3)
    size = model.geom_size[geom]
    if kind == "sphere":
        size = np.repeat(size[0], 3)
    material = int(model.geom_matid[geom])
    rgba = geom_rgba(model, geom)
    texture = -1
    if material >= 0:
        texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    checker, tint = None, np.ones(3)
    if texture >= 0:
        image = _texture(model, texture)
        tint = image.reshape(-1, 3).mean(axis=0)
        if kind == "plane":
            checker = _read_checker(model, material, image, size, rgba)
    return SceneGeom(
        geom_id=geom,
        kind=kind,
        size=_rgb(size),
        rgb=_rgb(np.asarray(rgba[:3]) * tint),
        emission=float(model.mat_emission[material]) if material >= 0 else 0.0,
        checker=checker,
        mocap=model.body(mocap).name if mocap else None,
        position=(data.geom_xpos[geom] - start).astype(np.float32),
        rotation=data.geom_xmat[geom].reshape(3, 3).astype(np.float32),
    )


def texture_bytes(model: mujoco.MjModel, texture: int) -> UInt8[np.ndarray, "h w c"]:
    """Return a view of a texture in its model; of a cube, its six sides are one below another."""
    sizes = model.tex_height, model.tex_width, model.tex_nchannel
    height, width, channels = (int(size[texture]) for size in sizes)
    start = int(model.tex_adr[texture])
    image = model.tex_data[start : start + height * width * channels]
    return image.reshape(height, width, channels)


def _texture(model: mujoco.MjModel, texture: int) -> Float[np.ndarray, "h w 3"]:
    """Return a texture's image, colours from 0 to 1."""
    image = texture_bytes(model, texture) / 255.0
    return image[..., :3] if image.shape[-1] >= 3 else np.repeat(image[..., :1], 3, axis=-1)


def skyboxes(model: mujoco.MjModel) -> list[int]:
    """Return the indices of a model's textures that are sky boxes."""
    return np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).tolist()


def _read_checker(
    model: mujoco.MjModel,
    material: int,
    image: Float[np.ndarray, "h w 3"],
    size: np.ndarray,
    rgba: Sequence[float],
) -> Checker | None:
    """Return the checker that a texture shows; None: it shows something else."""
    height, width, _ = image.shape
    upper, lower = np.array_split(image, 2)
    quadrants = [half for part in (upper, lower) for half in np.array_split(part, 2, axis=1)]
    colours = [quadrant[height // 4, width // 4] for quadrant in quadrants]
    plain = all(np.allclose(q, c, atol=0.01) for q, c in zip(quadrants, colours, strict=True))
    opposite = np.allclose(colours[0], colours[3]) and np.allclose(colours[1], colours[2])
    if not (plain and opposite):
        return None
    repeat = model.mat_texrepeat[material]
    # MuJoCo counts repetitions per metre if the texture is uniform or the plane infinite, else over
    # half of the plane, and a square is as long as a repetition. They begin at the origin of an
    # infinite plane, and at the corner of a finite one where x is least and y is greatest.
    spans = [1.0 if model.mat_texuniform[material] or half == 0 else half for half in size[:2]]
    tint = np.asarray(rgba[:3])
    return Checker(
        even=_rgb(colours[1] * tint),
        odd=_rgb(colours[0] * tint),
        size=(float(spans[0] / repeat[0]), float(spans[1] / repeat[1])),
        start=(-float(size[0]), float(size[1])),
    )


def _read_light(model: mujoco.MjModel, data: mujoco.MjData, light: int) -> Light:
    if model.light_type[light] != mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
        raise UserError(
            f"task.observation: the camera knows directional lights only, and light"
            f" {model.light(light).name or light!r} has a position: set its type to directional"
        )
    direction = data.light_xdir[light] / np.linalg.norm(data.light_xdir[light])
    return Light(direction.astype(np.float32), _rgb(model.light_diffuse[light]))


def _read_sky(model: mujoco.MjModel) -> tuple[Rgb, Rgb]:
    """Return the sky's colours at the horizon and at the zenith; black without a skybox."""
    skies = skyboxes(model)
    if not skies:
        return _SKY, _SKY
    image = _texture(model, skies[0])
    height, side, _ = image.shape
    if height // side != 6:
        mean = _rgb(image.reshape(-1, 3).mean(axis=0))
        return mean, mean
    # The sides are right, left, up, down, front, back: take the middles of right and up.
    middle = side // 2
    return _rgb(image[middle, middle]), _rgb(image[2 * side + middle, middle])
