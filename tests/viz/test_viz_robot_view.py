"""How shapes are drawn, against numbers worked out by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from deal_hw.sim.engine.scene import Shape, ShapeKind
from deal_hw.viz.robot_view import draw

HALF = math.sqrt(0.5)
QUARTER_TURN_ABOUT_Y = np.array([HALF, 0, HALF, 0])
SOLID, SEE_THROUGH = 3, 4


def _shape(kind: ShapeKind, **changes: Any) -> Shape:
    values: dict[str, Any] = {
        "name": "part",
        "body": 1,
        "kind": kind,
        "size": np.array([0.01, 0.15, 0.03]),
        "position": np.array([0.0, 0.0, 0.15]),
        "quaternion": np.array([1.0, 0, 0, 0]),
        "color": np.ones(4),
        "vertices": np.zeros((0, 3)),
        "faces": np.zeros((0, 3), dtype=np.int64),
    }
    return Shape(**{**values, **changes})


def _values(batch: Any) -> list[Any]:
    values: list[Any] = batch.as_arrow_array().to_pylist()
    return values


def test_capsules_are_moved_to_their_lower_cap() -> None:
    """Centred at z = 0.15 m with half length 0.15 m: from the origin; turned to x: from x = -0.15 m."""
    (upright,) = draw(_shape("capsule"), (1, 2, 3), ghost=False)
    np.testing.assert_allclose(_values(upright.translations)[0], [0, 0, 0], atol=1e-7)
    assert _values(upright.lengths) == pytest.approx([0.3])
    (lying,) = draw(_shape("capsule", quaternion=QUARTER_TURN_ABOUT_Y), (1, 2, 3), ghost=False)
    np.testing.assert_allclose(_values(lying.translations)[0], [-0.15, 0, 0.15], atol=1e-7)
    # rerun's order is x y z w.
    np.testing.assert_allclose(_values(lying.quaternions)[0], [0, HALF, 0, HALF], atol=1e-7)


@pytest.mark.parametrize(
    ("kind", "field", "expected"),
    [
        ("box", "half_sizes", [0.01, 0.15, 0.03]),
        ("ellipsoid", "half_sizes", [0.01, 0.15, 0.03]),
        ("sphere", "half_sizes", [0.01, 0.01, 0.01]),
        ("cylinder", "lengths", 0.3),
    ],
)
def test_sizes_are_what_mujoco_means(kind: ShapeKind, field: str, expected: Any) -> None:
    """MuJoCo's half sizes become what rerun asks for; ghosts are see-through."""
    (drawn,) = draw(_shape(kind), (1, 2, 3), ghost=True)
    np.testing.assert_allclose(_values(getattr(drawn, field))[0], expected, atol=1e-7)
    np.testing.assert_allclose(_values(drawn.centers)[0], [0, 0, 0.15], atol=1e-7)
    assert _values(drawn.fill_mode) == [SEE_THROUGH]
    (solid,) = draw(_shape(kind), (1, 2, 3), ghost=False)
    assert _values(solid.fill_mode) == [SOLID]


def test_meshes_keep_their_triangles() -> None:
    """A mesh is drawn with its vertices at its pose, and see-through as a ghost."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=float)
    mesh, pose = draw(_shape("mesh", vertices=corners, faces=np.array([[0, 1, 2]])), (1, 2, 3), ghost=True)
    assert _values(mesh.vertex_positions) == corners.tolist()
    assert _values(mesh.triangle_indices) == [[0, 1, 2]]
    assert _values(mesh.albedo_factor) == [1 << 24 | 2 << 16 | 3 << 8 | 110]
    np.testing.assert_allclose(_values(pose.translations)[0], [0, 0, 0.15], atol=1e-7)
