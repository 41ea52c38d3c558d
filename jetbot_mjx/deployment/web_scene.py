"""Describe what a web page draws: the bodies of a model with their visible parts."""

import base64
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jetbot_mjx.envs import geom_rgba

_VISIBLE_GROUPS = 3
"""Geoms of this group and above are hidden, as in MuJoCo's viewers."""

_KINDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")


class WebScene(NamedTuple):
    """A `WebScene` holds what a page draws."""

    bodies: list[int]
    """The bodies whose poses the page needs: the robot's base, and those with visible parts."""
    about: dict[str, Any]
    """The parts, as JSON values."""


def web_scene(model: mujoco.MjModel, goal: str = "goal") -> WebScene:
    """Describe the visible parts of a model, but for planes and height fields.

    Args:
      model: the model with its visual elements.
      goal: the body that marks the goal.
    """
    geoms, meshes = [], []
    # The first joint is that of the robot's base.
    bodies = [int(model.jnt_bodyid[0])]
    for index in range(model.ngeom):
        geom, rgba = model.geom(index), geom_rgba(model, index)
        kind = mujoco.mjtGeom(model.geom_type[index]).name.removeprefix("mjGEOM_").lower()
        if kind not in _KINDS or geom.group[0] >= _VISIBLE_GROUPS or rgba[3] == 0:
            continue
        body = int(geom.bodyid[0])
        if body not in bodies:
            bodies.append(body)
        part = {
            "body": bodies.index(body),
            "type": kind,
            "size": _rounded(geom.size),
            "pos": _rounded(geom.pos),
            "quat": _rounded(geom.quat),
            "rgba": _rounded(rgba),
        }
        if kind == "mesh":
            # Several geoms may show the same mesh.
            mesh = int(geom.dataid[0])
            part["mesh"] = meshes.index(mesh) if mesh in meshes else len(meshes)
            meshes += [] if mesh in meshes else [mesh]
        geoms.append(part)
    names = [model.body(body).name for body in bodies]
    about = {
        "bodies": len(bodies),
        "goal": names.index(goal) if goal in names else None,
        "geoms": geoms,
        "meshes": [_mesh(model, mesh) for mesh in meshes],
    }
    return WebScene(bodies, about)


def _mesh(model: mujoco.MjModel, index: int) -> dict[str, str]:
    """Return vertices [m] and faces of a mesh, as little-endian numbers in base64."""
    mesh = model.mesh(index)
    vertices = slice(mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0])
    faces = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
    return {
        "vertices": encoded(model.mesh_vert[vertices]),
        "faces": base64.b64encode(model.mesh_face[faces].astype("<u4").tobytes()).decode(),
    }


def encoded(numbers: np.ndarray) -> str:
    """Return float32 numbers as little-endian bytes in base64."""
    return base64.b64encode(np.asarray(numbers, "<f4").tobytes()).decode()


def _rounded(numbers: np.ndarray | tuple[float, ...]) -> list[float]:
    return [round(float(x), 6) for x in numbers]
