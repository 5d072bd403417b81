"""A robot as line drawings: each shape's outline in parallel projection, from where its motion shows most."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.scene import Shape, body_poses, read_scene
from deal_hw.sim.engine.tangent_coordinates import to_quaternion
from deal_hw.types import FloatArray

UP = np.array([0.0, 0.0, 1.0])


OUTLINE_POINTS: Final = 240
"""Points of the outline of round shapes."""
VIEWS: Final = 40
"""Moments of the motion that choose the view."""
PLANAR_SHARE: Final = 0.02
"""Largest share of motion across the plane of a planar motion."""
ELEVATION_RAD: Final = 0.2
"""Downward angle of the view of spatial motion [rad]."""
MARGIN: Final = 0.08
"""Margin around moving parts, share of their size."""
FINEST: Final = 1e-3
"""Precision of outlines, share of the picture."""
LEAST_SIDE: Final = 0.35
"""Least share of the picture's other side: a thin robot is not drawn as a line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outline:
    """The outline of one shape, a closed convex polygon.

    Attributes:
        name: The shape's name.
        points: Right and up in the picture, (n, 2) [m].
    """

    name: str
    points: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotDrawing:
    """A robot at one moment, once per predictor.

    Attributes:
        caption: The moment.
        box: Left, bottom, width and height of the picture [m]; moving parts lie inside.
        fixed: Parts of the world, far ones first; may reach out of the picture.
        moving: By predictor, such as "real" and "calibrated".
    """

    caption: str
    box: tuple[float, float, float, float]
    fixed: tuple[Outline, ...]
    moving: Mapping[str, tuple[Outline, ...]]


def draw_robot(
    robot: RobotModel,
    states: Mapping[str, FloatArray],
    motion: FloatArray,
    reference: FloatArray | None = None,
    caption: str = "",
) -> RobotDrawing | None:
    """Draw a robot; None where its model has no visible moving shape.

    Args:
        robot: The robot's model.
        states: Tangent coordinates of one moment by name, (C,).
        motion: Tangent coordinates of the motion around it, which choose the view, (T, C).
        reference: Reference orientations of a floating base, (T + 1, 4): of the motion, then of the moment.
        caption: The moment in words.
    """
    shapes = read_scene(robot).shapes
    # A body without a joint between it and the world is fixed.
    still = [robot.model.body_weldid[shape.body] == 0 for shape in shapes]
    if all(still):
        return None
    seen = motion[:: max(len(motion) // VIEWS, 1)]
    many = None if reference is None else reference[:-1][:: max(len(motion) // VIEWS, 1)]
    centres = _placed(robot, shapes, seen, many)[0][:, np.logical_not(still)]
    view = _view(centres)
    tip = None if reference is None else np.repeat(reference[-1:], len(states), axis=0)
    where, turned = _placed(robot, shapes, np.stack(list(states.values())), tip)
    drawn = {
        name: _outlines(shapes, where[i], turned[i], view)
        for i, name in enumerate(states)
        if np.isfinite(where[i]).all()
    }
    moving = {
        n: tuple(o for o, fixed in zip(some, still, strict=True) if not fixed) for n, some in drawn.items()
    }
    if not moving:
        return None
    fixed = tuple(o for o, fixed in zip(next(iter(drawn.values())), still, strict=True) if fixed)
    box = _box([o for some in moving.values() for o in some])
    return RobotDrawing(caption=caption, box=box, fixed=fixed, moving=moving)


def _placed(
    robot: RobotModel, shapes: tuple[Shape, ...], coordinates: FloatArray, reference: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return centres (T, G, 3) and orientations (T, G, 3, 3) of all shapes in the world."""
    base = None
    if robot.base is not None and reference is not None:
        base = np.concatenate(
            [coordinates[:, :3], to_quaternion(coordinates[:, robot.rotation], reference)], axis=1
        )
    where, turned = body_poses(robot, coordinates[:, robot.joints], base)
    bodies = [shape.body for shape in shapes]
    lost = ~np.isfinite(turned).all(axis=2, keepdims=True)
    frames = Rotation.from_quat(np.where(lost, [1.0, 0, 0, 0], turned).reshape(-1, 4), scalar_first=True)
    frame = frames.as_matrix().reshape(*turned.shape[:2], 3, 3)[:, bodies]
    own = Rotation.from_quat([shape.quaternion for shape in shapes], scalar_first=True).as_matrix()
    offset = np.array([shape.position for shape in shapes])
    return where[:, bodies] + np.einsum("tgij,gj->tgi", frame, offset), frame @ own


def _view(centres: FloatArray) -> FloatArray:
    """Return the picture's right, up and outward directions as rows, (3, 3), from a motion, (T, G, 3)."""
    moved = (centres - np.nanmean(centres, axis=0))[np.isfinite(centres).all(axis=(1, 2))].reshape(-1, 3)
    strength, axes = np.linalg.eigh(moved.T @ moved)
    total = max(float(strength.sum()), 1e-300)
    outward = axes[:, 0]
    if strength[1] < PLANAR_SHARE * total:
        # Along one line, or at rest, any view across it will do; the one from the side is usual.
        along = axes[:, 2] if abs(axes[2, 2]) < 0.9 and strength[2] > 0 else np.array([1.0, 0, 0])
        outward = np.cross(along, UP)
    flat = strength[0] < PLANAR_SHARE * total
    if abs(outward[2]) > 0.9 and flat:
        outward, up = UP, np.array([0.0, 1.0, 0.0])
    else:
        level = outward[:2] if np.hypot(*outward[:2]) > 0.1 else np.array([0.0, -1.0])
        level = level / np.hypot(*level)
        # The world's x or y to the right.
        level = level if level @ (0.3, -1.0) > 0 else -level
        tilt = 0.0 if flat else ELEVATION_RAD
        outward, up = np.array([*(np.cos(tilt) * level), np.sin(tilt)]), UP
    right = np.cross(up, outward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(outward, right), outward])


def _outlines(
    shapes: tuple[Shape, ...], where: FloatArray, turned: FloatArray, view: FloatArray
) -> tuple[Outline, ...]:
    """Return the outlines of shapes at centres (G, 3), turned (G, 3, 3), in the shapes' order."""
    size = float(np.ptp(where @ view[:2].T, axis=0).max()) or 1.0
    found = []
    for shape, centre, frame in zip(shapes, where, turned, strict=True):
        flat = (_surface(shape) @ frame.T + centre) @ view[:2].T
        found.append(Outline(name=shape.name, points=_hull(flat, FINEST * size)))
    return tuple(found)


def _surface(shape: Shape) -> FloatArray:
    """Return points with the shape as their convex hull, in its own frame, (n, 3) [m]."""
    if shape.kind == "mesh":
        return shape.vertices
    if shape.kind == "box":
        return np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T * shape.size
    radius, half = shape.size[:2]
    if shape.kind == "cylinder":
        turn = np.linspace(0, 2 * np.pi, OUTLINE_POINTS // 4, endpoint=False)
        ring = radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
        return np.concatenate([ring + half * UP, ring - half * UP])
    # Points of a sphere on a spiral from pole to pole.
    n = OUTLINE_POINTS
    z = np.linspace(1 - 1 / n, 1 / n - 1, n)
    angle = np.pi * (1 + 5**0.5) * np.arange(n)
    sphere = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    if shape.kind == "ellipsoid":
        return np.asarray(sphere * shape.size)
    if shape.kind == "capsule":
        return np.concatenate([radius * sphere + half * UP, radius * sphere - half * UP])
    return np.asarray(radius * sphere)


def _hull(points: FloatArray, finest: float) -> FloatArray:
    """Return the corners of a plane convex hull, (n, 2), without nearly straight ones."""
    try:
        corners = points[ConvexHull(points).vertices]
    except QhullError:
        # All points on one line: the two ends.
        along = np.linalg.svd(points - points.mean(axis=0))[2][0]
        order = np.argsort(points @ along)
        return points[order[[0, -1]]]
    kept = [corners[0]]
    for here, after in zip(corners[1:], np.roll(corners, -2, axis=0), strict=False):
        step = after - kept[-1]
        out = abs(step[0] * (here - kept[-1])[1] - step[1] * (here - kept[-1])[0])
        if out > finest * np.hypot(*step):
            kept.append(here)
    return np.array(kept)


def _box(outlines: list[Outline]) -> tuple[float, float, float, float]:
    points = np.concatenate([o.points for o in outlines])
    low, high = points.min(axis=0), points.max(axis=0)
    extent = np.maximum(high - low, 1e-6)
    size = (1 + 2 * MARGIN) * np.maximum(extent, LEAST_SIDE * extent.max())
    middle = (low + high) / 2
    left, bottom = middle - size / 2
    return float(left), float(bottom), float(size[0]), float(size[1])
