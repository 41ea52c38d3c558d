"""Convert the visible geoms of a MuJoCo model to triangle meshes, for other viewers."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import trimesh

from jetbot_mjx.envs import geom_rgba

_VISIBLE_GROUPS = (0, 1, 2)  # as in MuJoCo's viewer; collision geoms are in group 3
_ROUND = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID)


class Geom(NamedTuple):
    """A `Geom` holds the mesh of a visible geom."""

    name: str
    """Name of the geom, or its index if it has no name."""
    body: int
    """Index of its body."""
    mesh: trimesh.Trimesh
    """Surface in the frame of the body [m]."""
    rgba: tuple[float, float, float, float]
    """Colour and opacity, each in [0, 1]."""
    smooth: bool
    """Whether to use smooth shading, as for spheres and ellipsoids."""


def visible_geoms(model: mujoco.MjModel, sections: int = 48) -> Iterator[Geom]:
    """Return the meshes of all visible geoms, except for planes and height fields.

    Args:
      model: the model with all visual elements.
      sections: the number of faces around cylinders and capsules.

    Yields:
      The geoms, in the order of the model.
    """
    for index in range(model.ngeom):
        geom = model.geom(index)
        mesh = _mesh(model, index, sections)
        rgba = geom_rgba(model, index)
        if mesh is None or geom.group[0] not in _VISIBLE_GROUPS or rgba[3] == 0:
            continue
        pose_b = trimesh.transformations.quaternion_matrix(geom.quat)
        pose_b[:3, 3] = geom.pos
        yield Geom(
            name=geom.name or str(index),
            body=int(geom.bodyid[0]),
            mesh=mesh.apply_transform(pose_b),
            rgba=rgba,
            smooth=mujoco.mjtGeom(model.geom_type[index]) in _ROUND,
        )


def _mesh(model: mujoco.MjModel, index: int, sections: int) -> trimesh.Trimesh | None:
    """Return the surface of a geom around its centre; None for planes and height fields."""
    size = model.geom_size[index]
    match mujoco.mjtGeom(model.geom_type[index]):
        case mujoco.mjtGeom.mjGEOM_BOX:
            return trimesh.creation.box(2 * size)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return trimesh.creation.cylinder(size[0], 2 * size[1], sections=sections)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            mesh = trimesh.creation.capsule(2 * size[1], size[0], count=[sections // 2] * 2)
            return mesh.apply_translation(-mesh.bounds.mean(axis=0))
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return trimesh.creation.icosphere(_fineness(sections), size[0])
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return trimesh.creation.icosphere(_fineness(sections)).apply_scale(size)
        case mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[index])
            vertices = slice(mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0])
            faces = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
            return trimesh.Trimesh(model.mesh_vert[vertices], model.mesh_face[faces], process=False)
    return None


def _fineness(sections: int) -> int:
    """Return the subdivisions of an icosahedron with about so many faces around it."""
    return round(math.log2(sections / 6))
