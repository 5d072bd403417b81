"""The robot in 3D: the real one solid, predictions transparent."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from deal_hw.sim.engine.scene import Scene, Shape
from deal_hw.types import FloatArray
from deal_hw.viz.backend import rr
from deal_hw.viz.columns import Log
from deal_hw.viz.palette import Color

WORLD = "/world"


def log_surroundings(log: Log, scene: Scene) -> None:
    """Write the shapes that are fixed to the world, in their own colours."""
    log.stream.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for shape in scene.shapes:
        if shape.body == 0:
            color = tuple(round(255 * c) for c in shape.color)
            log.stream.log(
                f"{WORLD}/surroundings/{shape.name}", *draw(shape, color, ghost=False), static=True
            )


def log_robot(
    log: Log,
    scene: Scene,
    name: str,
    color: Color,
    poses: tuple[FloatArray, FloatArray],
    time_s: tuple[FloatArray, FloatArray],
    *,
    ghost: bool,
) -> None:
    """Write one robot that moves.

    Args:
        log: The log to write to.
        scene: Its shapes.
        name: ``"real"`` or the name of a parameter set.
        color: Of all its shapes; only the colour distinguishes two robots in the same place.
        poses: Positions (T, B, 3) and quaternions w x y z (T, B, 4) of the bodies.
        time_s: Device and host times, (T,) each.
        ghost: Whether to draw it transparent.
    """
    for body, body_name in enumerate(scene.bodies):
        shapes = [shape for shape in scene.shapes if shape.body == body]
        if body == 0 or not shapes:
            continue
        path = f"{WORLD}/{name}/{body_name}"
        log.poses(path, *time_s, poses[0][:, body], poses[1][:, body])
        for shape in shapes:
            log.stream.log(f"{path}/{shape.name}", *draw(shape, color, ghost=ghost), static=True)


def draw(shape: Shape, color: Iterable[int], *, ghost: bool) -> list[Any]:
    """Return the rerun archetypes that draw a shape in its body's frame."""
    fill = rr.components.FillMode.TransparentFillMajorWireframe if ghost else rr.components.FillMode.Solid
    red, green, blue, *alpha = color
    style: dict[str, Any] = {"colors": [(red, green, blue, *alpha)], "fill_mode": fill}
    turned = [np.roll(shape.quaternion, -1)]
    radius, half_length = float(shape.size[0]), float(shape.size[1])
    match shape.kind:
        case "box":
            return [
                rr.Boxes3D(half_sizes=[shape.size], centers=[shape.position], quaternions=turned, **style)
            ]
        case "ellipsoid" | "sphere":
            half = [shape.size if shape.kind == "ellipsoid" else np.full(3, radius)]
            return [rr.Ellipsoids3D(half_sizes=half, centers=[shape.position], quaternions=turned, **style)]
        case "cylinder":
            return [
                rr.Cylinders3D(
                    lengths=[2 * half_length],
                    radii=[radius],
                    centers=[shape.position],
                    quaternions=turned,
                    **style,
                )
            ]
        case "capsule":
            # MuJoCo places a capsule by its centre, rerun by the centre of its lower cap.
            low = shape.position - half_length * _z_axis(shape.quaternion)
            return [
                rr.Capsules3D(
                    lengths=[2 * half_length], radii=[radius], translations=[low], quaternions=turned, **style
                )
            ]
        case "mesh":
            factor = (red, green, blue, 110 if ghost else 255)
            pose = rr.InstancePoses3D(translations=[shape.position], quaternions=turned)
            mesh = rr.Mesh3D(
                vertex_positions=shape.vertices, triangle_indices=shape.faces, albedo_factor=factor
            )
            return [mesh, pose]


def _z_axis(quaternion: FloatArray) -> FloatArray:
    w, x, y, z = quaternion
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
