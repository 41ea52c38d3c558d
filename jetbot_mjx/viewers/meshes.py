"""Convert the visible geoms of a MuJoCo model to triangle meshes, for other viewers."""

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float

_SHOWN_GROUPS = (0, 1, 2)  # as in MuJoCo's own viewer; colliders are in group 3
_ROUND = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
_SECTIONS = 48  # of what is round
_PLAIN = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom that has none of its own


class Geom(NamedTuple):
    """One geom that shows, in the frame of its body."""

    name: str
    """Its own, or its number where it has none."""
    body: int
    """Its number."""
    position_b: Float[np.ndarray, "3"]
    """[m]"""
    quat_b: Float[np.ndarray, "4"]
    """(w, x, y, z)"""
    mesh: trimesh.Trimesh
    rgba: tuple[float, float, float, float]
    smooth: bool
    """Whether it is round everywhere, and its shading may hide the triangles."""


def shown_geoms(model: mujoco.MjModel) -> Iterator[Geom]:
    """Return all geoms that show, except planes and height fields.

    Args:
      model: with all that shows.

    Yields:
      Geoms, in the model's order.
    """
    for index in range(model.ngeom):
        geom = model.geom(index)
        mesh = _mesh(model, index)
        rgba = _rgba(model, index)
        if mesh is None or geom.group[0] not in _SHOWN_GROUPS or rgba[3] == 0:
            continue
        yield Geom(
            name=geom.name or str(index),
            body=int(geom.bodyid[0]),
            position_b=np.array(geom.pos),
            quat_b=np.array(geom.quat),
            mesh=mesh,
            rgba=rgba,
            smooth=mujoco.mjtGeom(model.geom_type[index]) in _ROUND,
        )


def _mesh(model: mujoco.MjModel, index: int) -> trimesh.Trimesh | None:
    """Return a geom's surface about its own centre; None for what is no closed surface."""
    size = model.geom_size[index]
    match mujoco.mjtGeom(model.geom_type[index]):
        case mujoco.mjtGeom.mjGEOM_BOX:
            return trimesh.creation.box(2 * size)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return trimesh.creation.cylinder(size[0], 2 * size[1], sections=_SECTIONS)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            mesh = trimesh.creation.capsule(2 * size[1], size[0], count=[_SECTIONS // 2] * 2)
            return mesh.apply_translation(-mesh.bounds.mean(axis=0))
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return trimesh.creation.icosphere(subdivisions=3, radius=size[0])
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return trimesh.creation.icosphere(subdivisions=3).apply_scale(size)
        case mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[index])
            vertices = slice(mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0])
            faces = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
            return trimesh.Trimesh(model.mesh_vert[vertices], model.mesh_face[faces], process=False)
    return None


def _rgba(model: mujoco.MjModel, index: int) -> tuple[float, float, float, float]:
    """Return the colour that MuJoCo draws: the geom's own, else its material's."""
    own, material = model.geom_rgba[index], model.geom_matid[index]
    if material >= 0 and np.allclose(own, _PLAIN):
        own = model.mat_rgba[material]
    red, green, blue, alpha = map(float, own)
    return red, green, blue, alpha
