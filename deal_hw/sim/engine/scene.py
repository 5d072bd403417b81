"""A robot's appearance: the shapes of its model and the poses of its bodies, as plain arrays for a viewer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.parameters.fields import element_names
from deal_hw.types import FloatArray, IntArray

ShapeKind = Literal["box", "sphere", "ellipsoid", "capsule", "cylinder", "mesh"]

_KINDS: dict[int, ShapeKind] = {
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
}
_VISIBLE_GROUPS = range(3)
"""MuJoCo's viewer shows groups 0 to 2; by convention, collision shapes are in the others."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One shape, fixed to a body.

    Attributes:
        name: Unique name.
        body: Index of the body it is fixed to; 0 is the world.
        kind: Kind of shape.
        size: Half extents (box, ellipsoid), or radius and half length along z (sphere, capsule, cylinder),
            (3,) [m].
        position: Of the centre, in the body's frame, (3,) [m].
        quaternion: In the body's frame, w x y z, (4,).
        color: Red, green, blue, alpha from 0 to 1, (4,).
        vertices: Of a mesh, (V, 3) [m]; empty otherwise.
        faces: Vertex indices of a mesh's triangles, (F, 3); empty otherwise.
    """

    name: str
    body: int
    kind: ShapeKind
    size: FloatArray
    position: FloatArray
    quaternion: FloatArray
    color: FloatArray
    vertices: FloatArray
    faces: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A robot's shapes.

    Attributes:
        bodies: Unique names of the bodies; the first is the world.
        shapes: The shapes that can be drawn; planes and height fields are left out.
    """

    bodies: tuple[str, ...]
    shapes: tuple[Shape, ...]


def read_scene(robot: RobotModel) -> Scene:
    """Return the visible shapes of a robot's model."""
    model = robot.model
    names = element_names(model, "geom")
    shapes = []
    for g in range(model.ngeom):
        kind = _KINDS.get(int(model.geom_type[g]))
        if kind is None or int(model.geom_group[g]) not in _VISIBLE_GROUPS or model.geom_rgba[g, 3] == 0:
            continue
        vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        if kind == "mesh":
            mesh = int(model.geom_dataid[g])
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            vertices = np.array(model.mesh_vert[first : first + count], dtype=float)
            first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
            faces = np.array(model.mesh_face[first : first + count], dtype=np.int64)
        shapes.append(
            Shape(
                name=names[g] or f"geom_{g}",
                body=int(model.geom_bodyid[g]),
                kind=kind,
                size=np.array(model.geom_size[g]),
                position=np.array(model.geom_pos[g]),
                quaternion=np.array(model.geom_quat[g]),
                color=np.array(model.geom_rgba[g], dtype=float),
                vertices=vertices,
                faces=faces,
            )
        )
    bodies = element_names(model, "body")
    return Scene(bodies=tuple(name or f"body_{b}" for b, name in enumerate(bodies)), shapes=tuple(shapes))


def body_poses(
    robot: RobotModel, position: FloatArray, base: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the poses of the bodies at each of T joint positions.

    Args:
        robot: The robot's model.
        position: Joint positions, (T, J) [m or rad].
        base: Position and quaternion wxyz of a floating base in the world, (T, 7); None for its place in the
            model.

    Returns:
        Positions (T, B, 3) [m] and quaternions w x y z (T, B, 4) of the B bodies in the world; NaN where a
        joint position is not finite.
    """
    model = robot.model
    data = mujoco.MjData(model)
    where = np.full((len(position), model.nbody, 3), np.nan)
    turned = np.full((len(position), model.nbody, 4), np.nan)
    known = np.isfinite(position).all(axis=1)
    if base is not None and robot.base is not None:
        known &= np.isfinite(base).all(axis=1)
    for t in np.flatnonzero(known):
        if base is not None and robot.base is not None:
            data.qpos[robot.base[0] : robot.base[0] + 7] = base[t]
        robot.place(data.qpos, position[t])
        mujoco.mj_kinematics(model, data)
        where[t], turned[t] = data.xpos, data.xquat
    return where, turned
